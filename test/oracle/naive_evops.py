"""The rules of EVOPS by the book: sets of pixels, loops, no tables.

Slow and plain on purpose; imports nothing of the product.
"""


def planes(labels, mask=None):
    """Label -> set of pixel positions, for the positive labels."""
    found = {}
    for row, line in enumerate(labels):
        for col, label in enumerate(line):
            if label > 0 and (mask is None or mask[row][col]):
                found.setdefault(int(label), set()).add((row, col))
    return found


def iou(one, other):
    return len(one & other) / len(one | other)


def figures(truth, machine, full=0.75, part=0.2):
    """All figures of two dicts of pixel sets, by name."""
    pairs = [(t, m) for t in truth for m in machine if iou(truth[t], machine[m]) >= full]
    precision = len(pairs) / len(machine) if machine else 0.0
    recall = len(pairs) / len(truth) if truth else 0.0
    f_score = 2 * precision * recall / (precision + recall) if pairs else 0.0
    mean = sum(iou(truth[t], machine[m]) for t, m in pairs) / len(pairs) if pairs else 0.0
    of_truth = {t: [m for m in machine if iou(truth[t], machine[m]) >= part] for t in truth}
    of_machine = {m: [t for t in truth if iou(truth[t], machine[m]) >= part] for m in machine}
    matched_truth, matched_machine = {t for t, _ in pairs}, {m for _, m in pairs}
    return {
        "truth_planes": len(truth),
        "machine_planes": len(machine),
        "matched": len(pairs),
        "precision": precision,
        "recall": recall,
        "f_score": f_score,
        "mean_iou": mean,
        "panoptic": mean * f_score,
        "over": sum(len(partners) > 1 for partners in of_truth.values()),
        "under": sum(len(partners) > 1 for partners in of_machine.values()),
        "missed": sum(_alone(t, of_truth, of_machine, matched_truth) for t in truth),
        "noise": sum(_alone(m, of_machine, of_truth, matched_machine) for m in machine),
    }


def _alone(one, partners, back, matched):
    """Neither matched, nor one of several partners, nor with several."""
    if not partners[one]:
        return True
    if one in matched or len(partners[one]) > 1:
        return False
    return len(back[partners[one][0]]) == 1
