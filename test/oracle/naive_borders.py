"""Connected parts and borders by plain counting; imports nothing of the product."""

import numpy as np

#: Neighbours of the middle of a 3 x 3 window, clockwise from the one above.
RING = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))


def components(mask):
    """4-connected parts of a (H, W) mask, numbered from 1 in scan order, by flooding."""
    out = np.zeros(mask.shape, int)
    count = 0
    for start in np.argwhere(mask).tolist():
        if out[tuple(start)]:
            continue
        count += 1
        out[tuple(start)] = count
        waiting = [start]
        while waiting:
            row, col = waiting.pop()
            for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
                inside = 0 <= r < mask.shape[0] and 0 <= c < mask.shape[1]
                if inside and mask[r, c] and not out[r, c]:
                    out[r, c] = count
                    waiting.append([r, c])
    return out


def parts_through_center(window):
    """4-connected parts of a 3 x 3 window without its middle that touch the middle by a side.

    0 where the ring is full: then the middle is no border pixel, and nothing is parted by a hole.
    """
    ring = window.copy()
    ring[1, 1] = 0
    if ring.sum() == 8:
        return 0
    pieces = components(ring > 0)
    sides = {pieces[0, 1], pieces[1, 0], pieces[1, 2], pieces[2, 1]} - {0}
    return len(sides)


def wrong_beside_creases(truth, depth, labels, step=0.015, reach=8):
    """Pixels within `reach` px of a crease of two truth surfaces that carry the label of the other side.

    A machine label stands for the truth surface that it covers most; a crease is a common border without a
    step of depth (relative) of more than `step`.
    """
    counts = np.zeros((truth.max() + 1, labels.max() + 1), int)
    np.add.at(counts, (truth.ravel(), labels.ravel()), 1)
    owner = counts.argmax(0)
    owner[0] = 0
    found = owner[labels]
    near = np.zeros(truth.shape, bool)
    wrong = np.zeros(truth.shape, bool)
    for a, b in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:])):
        differ = (truth[a] != truth[b]) & (truth[a] > 0) & (truth[b] > 0)
        differ &= np.abs(depth[a] - depth[b]) < step * np.minimum(depth[a], depth[b])
        for row, col in np.argwhere(differ).tolist():
            i, j = truth[a][row, col], truth[b][row, col]
            window = np.s_[max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1]
            here, machine = truth[window], found[window]
            wrong[window] |= ((here == i) & (machine == j)) | ((here == j) & (machine == i))
            near[window] = True
    return int(np.count_nonzero(wrong & near))
