"""How good a segmentation is, with the truth of its scene or without; the algorithm never asks.

May import: whatever users may, `result`, and `synthetic`. For others: `frames` (a data set or scenes in,
figures out), `plane_evaluation`, `uncertainty`, `metrics` (what each figure means), `pooling`.
"""
