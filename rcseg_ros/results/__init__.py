"""From a segmentation to messages, made on demand: the node publishes them, result bags hold them.

Needs no ROS: messages are built by whoever hands in the types. May import: `frames`, `patches`. For others:
`made.ResultMessages`, `messages.region_array`, `outputs`, `markers`.
"""
