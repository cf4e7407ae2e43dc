"""`rcseg evaluate`: figures, tables and pictures of data sets, and the references they are held to.

Needs no ROS. May import: `recordings`, the core's evaluation. For others: `evaluate.run_evaluate`,
`references`, `reports`, `options`.
"""
