"""Best-first growth over pixels with a plain priority queue; models evaluated by direct sums.

Slow and plain on purpose; imports nothing of the product.
"""

import heapq

FOUR = ((-1, 0), (1, 0), (0, -1), (0, 1))


def predict(coefficients, x, y):
    """sum of coefficients[a][b] x^a y^b."""
    total = 0.0
    for a, line in enumerate(coefficients):
        for b, value in enumerate(line):
            total += value * x**a * y**b
    return total


def grow(labels, free, within, cost, max_cost, buckets):
    """Unassigned pixels join the neighbour that costs least, the cheapest offer first (costs in buckets).

    free(row, col): may be absorbed; cost(label, row, col). Of equal offers the first is taken.
    """
    height, width = len(labels), len(labels[0])
    out = [list(map(int, line)) for line in labels]
    queue, number = [], 0

    def offer(row, col, giver):
        nonlocal number
        price = cost(giver, row, col)
        if price < max_cost:
            heapq.heappush(queue, (int(price * (buckets / max_cost)), number, row, col, giver))
            number += 1

    def around(row, col):
        for dr, dc in FOUR:
            r, c = row + dr, col + dc
            if 0 <= r < height and 0 <= c < width and within[r][c] == within[row][col]:
                yield r, c

    for row in range(height):
        for col in range(width):
            if out[row][col] == 0 and free(row, col):
                for r, c in around(row, col):
                    if out[r][c] > 0:
                        offer(row, col, out[r][c])
    while queue:
        _, _, row, col, giver = heapq.heappop(queue)
        if out[row][col]:
            continue
        out[row][col] = giver
        for r, c in around(row, col):
            if out[r][c] == 0 and free(r, c):
                offer(r, c, giver)
    return out
