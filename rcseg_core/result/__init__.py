"""What users hold: labels, regions with patches, surfaces, the tree, the image they stand for.

Computes only when asked and changes nothing. May import: `shapes`, `graph`, `models`, `signal`, not how the
partition came about. For others: `Segmentation`, `Region`, `Surface`; `drawing` and `extents`.
"""
