"""Distances to planes, spheres and cylinders from their definitions, and derivatives by differences."""

import math


def _minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def distance(kind, shape, point):
    """Signed distance of a point (3,): positive on the side of the normal, or outside."""
    local = _minus(point, shape.point)
    along = _dot(local, shape.direction)
    if kind == "plane":
        return along
    if kind == "sphere":
        return math.sqrt(_dot(local, local)) - shape.radius
    return math.sqrt(max(_dot(local, local) - along * along, 0.0)) - shape.radius


def along(kind, shape, point, direction):
    """How far a point (3,) is beyond the shape along a direction (3,), by bisection near the point."""

    def off(t):
        return distance(kind, shape, [p - t * d for p, d in zip(point, direction, strict=True)])

    low, high = -0.03, 0.03
    assert off(low) * off(high) <= 0, "the shape is not near"
    for _ in range(80):
        middle = 0.5 * (low + high)
        if off(low) * off(middle) <= 0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


def _basis(direction):
    """Two directions across `direction`, as the product chooses them: by its smallest component."""
    least = min(range(3), key=lambda i: abs(direction[i]))
    axis = [1.0 if i == least else 0.0 for i in range(3)]
    first = _cross(direction, axis)
    length = math.sqrt(_dot(first, first))
    first = [x / length for x in first]
    return first, _cross(direction, first)


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _after(kind, shape, parameter, step):
    """The shape with one local parameter changed."""
    first, second = _basis(shape.direction)
    point, direction, radius = list(shape.point), list(shape.direction), shape.radius
    if kind == "sphere":
        if parameter == 3:
            radius += step
        else:
            point[parameter] += step
        return shape._replace(point=point, radius=radius)
    tilts = {"plane": (0, 1), "cylinder": (2, 3)}[kind]
    if parameter in tilts:
        way = (first, second)[tilts.index(parameter)]
        direction = [d + step * w for d, w in zip(direction, way, strict=True)]
        length = math.sqrt(_dot(direction, direction))
        direction = [d / length for d in direction]
    elif kind == "plane":
        point = [p + step * d for p, d in zip(point, direction, strict=True)]
    elif parameter == 4:
        radius += step
    else:
        point = [p + step * w for p, w in zip(point, (first, second)[parameter], strict=True)]
    return shape._replace(point=point, direction=direction, radius=radius)


def numeric_table(kind, shape, points):
    """(m, q) derivatives of the distances by the local parameters, by central differences."""
    import numpy as np

    count = {"plane": 3, "sphere": 4, "cylinder": 5}[kind]
    step = 1e-6
    return np.array(
        [
            [
                (
                    distance(kind, _after(kind, shape, j, step), p)
                    - distance(kind, _after(kind, shape, j, -step), p)
                )
                / (2 * step)
                for j in range(count)
            ]
            for p in points
        ]
    )
