"""The partition while it grows: seeds (section 5), merges, parting; labels, tree and sums in step.

`Partition` is the one structure that stages change, by its methods alone. May import: `pixels`, `graph`,
`decision`, `models`, `signal`. For others: `Partition`, `initial_partition`, `split_creases`,
`dissolve_chamfers`.
"""
