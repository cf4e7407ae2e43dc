"""Regions as nodes: who touches whom, which pair is merged next, the tree of merges (section 6).

Knows labels and moments. May import: `decision`, `models`, `signal`. For others: `Pairs` and `find_pairs`,
`group` and `Grouped`, `continuous_pairs`, `Hierarchy`.
"""
