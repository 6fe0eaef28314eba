"""Codes that cost few bits, as near to their targets as what shows requires: bits + cost x distance^2 at its smallest."""

import numpy as np

from gsplat_tools.kernels._jit import kernel


@kernel()
def relax_numbers(targets, costs, bits, carry, most, low, high, start, stop, codes):
    """Integers near their targets whose low byte is cheap.

    targets      float64 (N,)   read; in steps, low - 0.5 <= target <= high + 0.5
    costs        float64 (N,)   read; bits per squared step
    bits         float32 (256,) read; of each low byte
    carry        float          bits for leaving the high byte of the nearest integer
    most         float          largest cost x distance^2 of anything but the nearest
    low, high    int            range of codes
    start, stop  int            rows to do
    codes        int64 (N,)     written; of equally good ones the smallest
    """
    for i in range(start, stop):
        nearest = min(max(np.int64(np.rint(targets[i])), low), high)
        reach = np.int64(min(255.0, 1.0 + np.sqrt(most / costs[i])))
        best, chosen = np.inf, nearest
        for code in range(max(low, nearest - reach), min(high, nearest + reach) + 1):
            distance = (code - targets[i]) * (code - targets[i]) * costs[i]
            if distance > most and code != nearest:
                continue
            total = distance + bits[code & 255]
            if (code >> 8) != (nearest >> 8):
                total += carry
            if total < best:
                best, chosen = total, code
        codes[i] = chosen


@kernel()
def relax_colors(targets, costs, codebook, bits, reach, most, start, stop, codes):
    """Three indices into one ascending codebook, where green is stored and red and blue as their difference from it.

    targets      float32 (N, 3)   read
    costs        float64 (N,)     read; bits per square of a value
    codebook     float32 (K,)     read; ascending, K <= 256
    bits         float32 (3, 256) read; of red less green, green, blue less green, differences modulo 256
    reach        int              how many entries from the nearest are looked at
    most         float            largest cost x distance^2 of anything but the nearest, for each channel
    start, stop  int              rows to do
    codes        uint8 (N, 3)     read: the nearest; written
    """
    size = codebook.shape[0]
    least_bits = np.float64(bits[0].min()) + np.float64(bits[2].min())
    for i in range(start, stop):
        nearest_r, nearest_g, nearest_b = np.int64(codes[i, 0]), np.int64(codes[i, 1]), np.int64(codes[i, 2])
        best = np.inf
        best_r, best_g, best_b = nearest_r, nearest_g, nearest_b
        # Outwards from the nearest, down and up: distances rise, so that each way ends early.
        for way in (-1, 1):
            for away in range(0 if way < 0 else 1, reach + 1):
                g = nearest_g + way * away
                if g < 0 or g >= size:
                    break
                offset = np.float64(codebook[g]) - np.float64(targets[i, 1])
                distance = offset * offset * costs[i]
                if away > 0 and (distance > most or distance + least_bits >= best):
                    break
                total = distance + bits[1, g]
                if total + least_bits >= best:
                    continue
                least_r, r = _cheapest(targets[i, 0], costs[i], codebook, bits[0], g, nearest_r, reach, most)
                least_b, b = _cheapest(targets[i, 2], costs[i], codebook, bits[2], g, nearest_b, reach, most)
                total += least_r + least_b
                if total < best:
                    best = total
                    best_r, best_g, best_b = r, g, b
        codes[i, 0], codes[i, 1], codes[i, 2] = np.uint8(best_r), np.uint8(best_g), np.uint8(best_b)


@kernel()
def _cheapest(target, cost, codebook, bits, green, nearest, reach, most):
    """Return the smallest sum of bits and cost of one channel, and its index."""
    least, chosen = np.inf, nearest
    for way in (-1, 1):
        for away in range(0 if way < 0 else 1, reach + 1):
            k = nearest + way * away
            if k < 0 or k >= codebook.shape[0]:
                break
            offset = np.float64(codebook[k]) - np.float64(target)
            distance = offset * offset * cost
            if away > 0 and (distance > most or distance >= least):
                break
            total = distance + bits[(k - green) & 255]
            if total < least:
                least, chosen = total, k
    return least, chosen


@kernel()
def relax_rotations(quats, costs, bits, most, max_turn, start, stop, codes):
    """Four bytes (b - 128, normalized by the decoder) near a rotation: one component after the other, twice.

    The turn from the source q to the stored p has the vector part u of conj(q) p / |p|; it costs sum_k cost_k (2 u_k)^2.

    quats        float64 (N, 4)   read, wxyz, unit length
    costs        float64 (N, 3)   read; bits per squared radian about each local axis
    bits         float32 (4, 256) read; of each byte
    most         float            largest cost of anything but what is there
    max_turn     float            largest |u| of anything but what is there
    start, stop  int              rows to do
    codes        uint8 (N, 4)     read: where the search starts; written
    """
    point = np.empty(4, np.int64)
    for i in range(start, stop):
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        for k in range(4):
            point[k] = np.int64(codes[i, k]) - 128
        turn = _turn(w, x, y, z, point, costs, i, 2.0)
        best = turn
        for k in range(4):
            best += bits[k, point[k] + 128]
        for _ in range(2):
            for k in range(4):
                before = point[k]
                chosen = before
                # Turning by one step of a component of p costs the most about the axis with the largest cost.
                square = point[0] * point[0] + point[1] * point[1] + point[2] * point[2] + point[3] * point[3]
                total_cost = costs[i, 0] + costs[i, 1] + costs[i, 2]
                reach = np.int64(min(64.0, 2.0 + np.sqrt(most * square / (4.0 * total_cost))))
                rest = best - turn - bits[k, before + 128]
                turn_chosen = turn
                for code in range(max(-127, before - reach), min(127, before + reach) + 1):
                    if bits[k, code + 128] + rest >= best:
                        continue
                    point[k] = code
                    cost = _turn(w, x, y, z, point, costs, i, max_turn)
                    total = cost + rest + bits[k, code + 128]
                    if total < best and cost <= most:
                        best, chosen, turn_chosen = total, code, cost
                point[k] = chosen
                turn = turn_chosen
        for k in range(4):
            codes[i, k] = np.uint8(point[k] + 128)


@kernel()
def _turn(w, x, y, z, point, costs, i, max_turn):
    """Return what the turn from a unit quaternion to a lattice point costs; infinitely much beyond `max_turn`."""
    a, b, c, d = np.float64(point[0]), np.float64(point[1]), np.float64(point[2]), np.float64(point[3])
    square = a * a + b * b + c * c + d * d
    if square == 0.0:
        return np.inf
    u = w * b - x * a - y * d + z * c
    v = w * c - y * a - z * b + x * d
    t = w * d - z * a - x * c + y * b
    if u * u + v * v + t * t > max_turn * max_turn * square:
        return np.inf
    return 4.0 * (costs[i, 0] * u * u + costs[i, 1] * v * v + costs[i, 2] * t * t) / square


@kernel()
def relax_labels(points, costs, centroids, bits, order, most, start, stop, labels):
    """Entries near the points that cost few bits.

    points       float32 (N, D)  read
    costs        float64 (N,)    read; bits per squared distance
    centroids    float32 (K, D)  read
    bits         float32 (K,)    read; of each label
    order        int64 (M,)      read; labels to try, bits rising
    most         float           largest cost that is added to that of the label there is
    start, stop  int             rows to do
    labels       int64 (N,)      read: the nearest; written
    """
    for i in range(start, stop):
        least = 0.0
        for d in range(points.shape[1]):
            offset = np.float64(points[i, d]) - np.float64(centroids[labels[i], d])
            least += offset * offset
        least *= costs[i]
        best, chosen = least + bits[labels[i]], labels[i]
        for k in order:
            # The cheapest come first, and none is nearer than the nearest.
            if bits[k] + least >= best:
                break
            limit = min(best - bits[k], least + most)
            distance = 0.0
            for d in range(points.shape[1]):
                offset = np.float64(points[i, d]) - np.float64(centroids[k, d])
                distance += offset * offset * costs[i]
                if distance >= limit:
                    break
            if distance < limit:
                best, chosen = distance + bits[k], k
        labels[i] = chosen
