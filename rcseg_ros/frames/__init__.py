"""From messages, live or recorded, to registered frames: pure functions of what a message holds.

Needs no ROS. May import: the core. For others: `conversions` (one door for all messages), `assembly`,
`sync`, `registration`, `extrinsic`, `reading`.
"""
