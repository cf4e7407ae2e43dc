"""Errors that a user can act on: each message names what came, what was expected and what to do.

The command line prints them as one line and exits with code 2; the ROS node counts them as rejections.
"""


class RcsegError(ValueError):
    """Base of every error that rcseg raises on purpose."""


class InputError(RcsegError):
    """A frame, file, bag or message that cannot be used as it is."""


class ConfigError(RcsegError):
    """An unknown parameter, a wrong type or a value out of bounds."""
