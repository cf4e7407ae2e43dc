"""The node's own files: topics, parameters, one worker, diagnostics. The only room that imports rclpy.

May import: `frames`, `results`; never recordings or commands. For others: `node`, which wires them
up.
"""
