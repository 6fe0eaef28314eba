"""Radix sort of 32-bit keys with a 32-bit payload, in the passes of a device: upsweep, scan, downsweep.

Key and payload travel as one 64-bit word, key above payload: one store for each move.

Source: Merrill and Grimshaw 2011, High Performance and Scalable Radix Sorting.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel

DIGIT_BITS = 8
NUM_DIGITS = 1 << DIGIT_BITS

_SIGN = np.uint32(0x80000000)
_ALL = np.uint32(0xFFFFFFFF)
_INFINITY_BITS = np.uint32(0x7F800000)
_KEY_SHIFT = np.uint64(32)
_DIGIT_MASK = np.uint64(NUM_DIGITS - 1)


@kernel()
def sortable_bits(bits, nan_last, start, stop, keys):
    """Map the bits of floats to unsigned integers of the same order: -0 below +0, every bit pattern kept apart.

    bits         uint32 (N,)  read
    nan_last     bool         whether every NaN gets the last key instead of its own
    start, stop  int          range
    keys         uint32 (N,)  written
    """
    for i in range(start, stop):
        value = bits[i]
        key = np.uint32(value ^ (_ALL if value & _SIGN else _SIGN))
        is_nan = np.uint32(value & ~_SIGN) > _INFINITY_BITS
        keys[i] = _ALL if nan_last & is_nan else key


@kernel()
def join_words(keys, payload, start, stop, words, counts):
    """Join keys and payload, and count the lowest digit on the way: its upsweep.

    keys         uint32 (N,)          read
    payload      uint32 (N,)          read; empty: the index
    start, stop  int                  the block
    words        uint64 (N,)          written
    counts       int64 (NUM_DIGITS,)  added to
    """
    has_payload = len(payload) > 0
    for i in range(start, stop):
        key = np.uint64(keys[i])
        words[i] = np.uint64(key << _KEY_SHIFT) | np.uint64(payload[i] if has_payload else i)
        counts[key & _DIGIT_MASK] += 1


@kernel()
def upsweep(words, shift, start, stop, counts):
    """Count the digits of a block.

    words        uint64 (N,)          read
    shift        int                  position of the digit in the key, bits
    start, stop  int                  the block
    counts       int64 (NUM_DIGITS,)  added to
    """
    position = _KEY_SHIFT + np.uint64(shift)
    for i in range(start, stop):
        counts[np.uint64(words[i] >> position) & _DIGIT_MASK] += 1


@kernel()
def scan(counts, offsets):
    """Find where each block writes each digit: an exclusive scan over digits, then blocks. Return how many digits occur.

    counts   int64 (blocks, NUM_DIGITS)  read
    offsets  int64 (blocks, NUM_DIGITS)  written
    """
    position = 0
    num_found = 0
    for digit in range(NUM_DIGITS):
        first = position
        for block in range(len(counts)):
            offsets[block, digit] = position
            position += counts[block, digit]
        num_found += 1 if position > first else 0
    return num_found


@kernel()
def downsweep(words, shift, start, stop, offsets, out):
    """Scatter a block by its digit, keeping the order of equal digits.

    words        uint64 (N,)          read
    shift        int                  position of the digit in the key, bits
    start, stop  int                  the block
    offsets      int64 (NUM_DIGITS,)  read and advanced; next place of each digit
    out          uint64 (N,)          written; must not alias words
    """
    position = _KEY_SHIFT + np.uint64(shift)
    for i in range(start, stop):
        word = words[i]
        digit = np.uint64(word >> position) & _DIGIT_MASK
        place = offsets[digit]
        offsets[digit] = place + 1
        out[np.uintp(place)] = word


@kernel()
def split_words(words, start, stop, keys, payload):
    """Part words into keys and payload.

    words        uint64 (N,)  read
    start, stop  int          range
    keys         uint32 (N,)  written
    payload      uint32 (N,)  written
    """
    for i in range(start, stop):
        keys[i] = np.uint32(words[i] >> _KEY_SHIFT)
        payload[i] = np.uint32(words[i] & np.uint64(0xFFFFFFFF))
