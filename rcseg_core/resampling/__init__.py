"""The scene seen otherwise: in larger squares, or a scanner's grid as a pinhole sees it; and back.

May import: every room of the pipeline. For others: `pinhole_view` and `carried_back`, `reduced` and
`at_full_size`.
"""
