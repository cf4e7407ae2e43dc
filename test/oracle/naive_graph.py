"""Region adjacency and best-first grouping by brute force: every pixel, every pair, every time.

Slow and plain on purpose; imports nothing of the product.
"""

import numpy as np

from .naive_patch import rise


def spread(labels, edges, rounds):
    """Labels grown by breadth-first steps over 0 pixels, and the edge bits met on the way.

    A free pixel is taken by the region that reaches it first; within a step pixels come in the order in which
    they were reached (raster order to begin with), and each looks up, down, left, right.
    """
    height, width = len(labels), len(labels[0])
    cells = [list(map(int, line)) for line in labels]
    met = [list(map(int, line)) for line in edges]
    front = [(r, c) for r in range(height) for c in range(width) if cells[r][c] > 0]
    for _ in range(rounds):
        reached = []
        for r, c in front:
            for rr, cc in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
                if 0 <= rr < height and 0 <= cc < width and cells[rr][cc] == 0:
                    cells[rr][cc] = cells[r][c]
                    met[rr][cc] |= met[r][c]
                    reached.append((rr, cc))
        front = reached
    return cells, met


def pairs(labels, edges, max_gap):
    """{(a, b): [boundary, with a range edge, with a colour edge]} of adjacent regions, a < b."""
    cells, met = spread(labels, edges, (max_gap + 1) // 2)
    found = {}
    for r in range(len(cells)):
        for c in range(len(cells[0])):
            for rr, cc in ((r + 1, c), (r, c + 1)):
                if rr >= len(cells) or cc >= len(cells[0]):
                    continue
                a, b = cells[r][c], cells[rr][cc]
                if a > 0 and b > 0 and a != b:
                    bits = met[r][c] | met[rr][cc]
                    entry = found.setdefault((min(a, b), max(a, b)), [0, 0, 0])
                    entry[0] += 1
                    entry[1] += bool(bits & 3)
                    entry[2] += bool(bits & 4)
    return found


def error_gain(correlation, systematic2, n, q):
    """What q coefficients gain on n pixels of error alone: the mean and four deviations, in sigma^2.

    The misses along q orthonormal directions are normal, each with the variance of a correlated error, one
    number in `correlation` pixels, and with its share of the square sum of a systematic error that lies in
    these directions altogether.
    """
    each = correlation + n * systematic2 / q
    mean, variance = q * each, 2 * q * each**2
    return mean + 4 * variance**0.5


def plane_ratio(x, y, values, one, other, n_range, errors, tolerances2, whole=False):
    """Largest of (rise of the residual) / (gain of the error + n tolerance^2) over sides and modalities.

    one, other : (n,) bool masks of pixels; errors : (correlation, systematic2), tolerances2 : squared
    tolerance of a pixel, both by modality. whole : both sides together, as Chow's test does.
    """
    exponents = [(0, 0), (1, 0), (0, 1)]
    joint = one | other
    worst = 0.0
    for modality, channels in enumerate((slice(0, n_range), slice(n_range, None))):
        if values[:, channels].shape[1] == 0:
            continue
        rises = [rise(x, y, values[:, channels], side, exponents, joint) for side in (one, other)]
        sizes = [int(one.sum()), int(other.sum())]
        if whole:
            rises, sizes = [sum(rises)], [sum(sizes)]
        for height, n in zip(rises, sizes, strict=True):
            error = error_gain(*errors[modality], n, 3 * values[:, channels].shape[1])
            worst = max(worst, height / (error + n * tolerances2[modality]))
    return worst


def group(count, adjacent, ratio):
    """Merge the pair of least ratio until none is below one; all pairs are looked at anew each time.

    adjacent : set of (a, b), a < b; ratio(members_a, members_b) of two sets of seeds.
    Returns the merges (kept, gone); the larger keeps its number, of equals the lower. Sizes by `ratio.size`.
    """
    members = {k: {k} for k in range(1, count + 1)}
    links = {tuple(sorted(pair)) for pair in adjacent}
    merges, heights = [], []
    while True:
        best = min(
            ((ratio(members[a], members[b]), a, b) for a, b in links),
            default=(np.inf, 0, 0),
        )
        if best[0] > 1:
            return merges, heights
        _, a, b = best
        size_a, size_b = ratio.size(members[a]), ratio.size(members[b])
        keep, gone = (a, b) if size_a > size_b or (size_a == size_b and a < b) else (b, a)
        merges.append((keep, gone))
        heights.append(best[0])
        members[keep] |= members.pop(gone)
        moved = {tuple(sorted(keep if k == gone else k for k in pair)) for pair in links}
        links = {pair for pair in moved if pair[0] != pair[1]}


class PlaneRatio:
    """`ratio` for `group`: planes fitted to the pixels of two sets of seeds, tolerances gated by edges.

    label (n,) seed of each pixel; errors : (correlation, systematic2), eps2 : squared tolerance of a pixel,
    both by modality; tallies : {(a, b): [boundary, range edges, colour edges]} of seeds, or None for no gate.
    """

    def __init__(self, x, y, values, label, n_range, errors, eps2, tallies=None, whole=False):
        self.pixels, self.label, self.n_range = (x, y, values), label, n_range
        self.errors, self.eps2, self.tallies, self.whole = errors, eps2, tallies, whole

    def size(self, members):
        return int(np.isin(self.label, list(members)).sum())

    def gates(self, one, other):
        if self.tallies is None:
            return 1.0, 1.0
        total = np.zeros(3)
        for (a, b), tally in self.tallies.items():
            if (a in one and b in other) or (b in one and a in other):
                total += tally
        return 1 - total[1] / total[0], 1 - total[2] / total[0]

    def __call__(self, one, other):
        gates = self.gates(one, other)
        allowed2 = [eps2 * gate**2 for eps2, gate in zip(self.eps2, gates, strict=True)]
        a, b = (np.isin(self.label, list(m)) for m in (one, other))
        return plane_ratio(*self.pixels, a, b, self.n_range, self.errors, allowed2, self.whole)
