"""Hoover's classification and the agreement measures by the book: sets of pixels, loops, no tables.

Slow and plain on purpose; imports nothing of the product.
"""

import itertools
import math


def regions(labels, mask=None):
    """Label -> set of pixel positions, for the positive labels."""
    found = {}
    for row, line in enumerate(labels):
        for col, label in enumerate(line):
            if label > 0 and (mask is None or mask[row][col]):
                found.setdefault(int(label), set()).add((row, col))
    return found


def classify(truth, machine, tolerance):
    """Classes of the truth and the machine regions: two dicts label -> class name."""
    instances = []
    for n, pixels in truth.items():
        for m, others in machine.items():
            shared = len(pixels & others)
            if shared >= tolerance * len(others) and shared >= tolerance * len(pixels):
                average = (shared / len(pixels) + shared / len(others)) / 2
                instances.append((average, 0, "correct", [n], [m]))
    for n, pixels in truth.items():
        parts = [m for m, others in machine.items() if len(pixels & others) >= tolerance * len(others)]
        shared = sum(len(pixels & machine[m]) for m in parts)
        if len(parts) >= 2 and shared >= tolerance * len(pixels):
            average = (shared / len(pixels) + shared / sum(len(machine[m]) for m in parts)) / 2
            instances.append((average, 1, "over", [n], parts))
    for m, pixels in machine.items():
        parts = [n for n, others in truth.items() if len(pixels & others) >= tolerance * len(others)]
        shared = sum(len(pixels & truth[n]) for n in parts)
        if len(parts) >= 2 and shared >= tolerance * len(pixels):
            average = (shared / len(pixels) + shared / sum(len(truth[n]) for n in parts)) / 2
            instances.append((average, 2, "under", parts, [m]))
    truth_class, machine_class = dict.fromkeys(truth, "missed"), dict.fromkeys(machine, "noise")
    for _, _, kind, ns, ms in sorted(instances, key=lambda i: (-i[0], i[1])):
        if all(truth_class[n] == "missed" for n in ns) and all(machine_class[m] == "noise" for m in ms):
            truth_class.update(dict.fromkeys(ns, kind))
            machine_class.update(dict.fromkeys(ms, kind))
    return truth_class, machine_class


def information(truth, machine):
    """H(machine | truth) and H(truth | machine) in bits of two lists of labels."""
    n = len(truth)
    split = merge = 0.0
    for a in set(truth):
        for b in set(machine):
            both = sum(1 for x, y in zip(truth, machine, strict=True) if x == a and y == b)
            if both:
                split -= both / n * math.log2(both / truth.count(a))
                merge -= both / n * math.log2(both / machine.count(b))
    return split, merge


def rand(truth, machine):
    """Share of pairs of pixels that both partitions treat alike."""
    pairs = list(itertools.combinations(range(len(truth)), 2))
    agree = sum((truth[i] == truth[j]) == (machine[i] == machine[j]) for i, j in pairs)
    return agree / len(pairs)


def covering(truth, machine):
    """Mean over the truth's pixels of the best IoU of their region."""
    total = sum(len(pixels) for pixels in truth.values())
    best = 0.0
    for pixels in truth.values():
        ious = [len(pixels & others) / len(pixels | others) for others in machine.values()]
        best += len(pixels) / total * max(ious, default=0.0)
    return best


def boundary_recall(truth, machine, within):
    """As documented, by looking at every pair of border pixels; lists of lists, all pixels valid."""
    height, width = len(truth), len(truth[0])

    def on_border(labels, row, col, both):
        here = labels[row][col]
        for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            if 0 <= r < height and 0 <= c < width:
                there = labels[r][c]
                if there != here and (not both or (there > 0 and here > 0)):
                    return True
        return False

    cells = list(itertools.product(range(height), range(width)))
    wanted = [cell for cell in cells if on_border(truth, *cell, True)]
    drawn = [cell for cell in cells if on_border(machine, *cell, False)]
    if not wanted:
        return math.nan
    found = sum(any(math.dist(cell, other) <= within for other in drawn) for cell in wanted)
    return found / len(wanted)
