"""Recordings in and out: which files make one, what its topics are, frames from it, result bags to play.

Needs no ROS. May import: `frames`, `results`. For others: `bag.Recording`, `topics.find_topics`,
`recorded`, `segmenting`, `result_bag.BagWriter`, `staging`.
"""
