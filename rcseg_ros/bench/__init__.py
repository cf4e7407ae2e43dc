"""`rcseg bench`: time, memory and accuracy of presets and peers in one run.

Needs no ROS. May import: `evaluation` for its figures and tables. For others: `run`, `report`.
"""
