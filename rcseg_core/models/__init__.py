"""What a region is to the algorithm: sums over its pixels, and the surfaces that follow (section 4).

Knows one region at a time, not its neighbours, and decides nothing. May import: `signal`. For others:
`Moments` and `accumulate`, `Models`, `fit_models` and `pixel_cost`, `BezierPatch`.
"""
