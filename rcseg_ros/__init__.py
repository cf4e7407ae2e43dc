"""The ROS 2 layer of rcseg: one sync and one set of conversions for live topics and recordings."""
