"""What `rcseg` does beside evaluation and bench: replay, segment, inspect, view, calibrate.

Needs no ROS, but for `rcseg view` of live topics. May import: every room but `live`. For others: the doors
of `cli` alone.
"""
