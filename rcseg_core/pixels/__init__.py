"""Which region a single pixel belongs to: absorbed, moved over a border, in mid-air, in a hole.

Changes label images in place and says whether it did. May import: `graph`, `models`, `signal`. For others:
`absorb` and `refine`, `sharpen`, `treat_flying` and `fill_holes`.
"""
