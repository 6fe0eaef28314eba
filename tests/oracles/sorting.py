"""Sorting as numpy does it."""

import struct

import numpy as np


def float_to_sortable(value):
    """Return the unsigned integer of one float32: all bits flipped where it is negative, else the sign bit alone."""
    (bits,) = struct.unpack("<I", struct.pack("<f", value))
    return bits ^ (0xFFFFFFFF if bits >> 31 else 0x80000000)


def sort_pairs(keys, values):
    """Return keys in ascending order and the values that go with them; equal keys keep their order."""
    order = np.argsort(keys, kind="stable")
    return keys[order], values[order]


def far_first(depths, hidden=None):
    """Return indices by falling depth; hidden and NaN last, ties in order of the index."""
    last = np.isnan(depths) if hidden is None else np.isnan(depths) | hidden
    shown = np.flatnonzero(~last)
    return np.concatenate([shown[np.argsort(-depths[shown], kind="stable")], np.flatnonzero(last)])
