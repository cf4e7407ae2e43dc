"""What is said of a message that cannot be used."""

from __future__ import annotations

from rcseg_core.errors import InputError


class MessageError(InputError):
    """A message that cannot be used; ``reason`` is its name in counters and diagnostics."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def megabytes(size: int) -> str:
    """A number of bytes for people."""
    return f"{size} bytes" if size < 10_000_000 else f"{size / 1e6:.0f} MB"
