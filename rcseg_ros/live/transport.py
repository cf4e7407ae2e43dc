"""How large messages reach this process, settled before rclpy starts.

Fast DDS sends on one machine through a shared memory of half a megabyte that belongs to the *writer*. A
cloud of megabytes overruns it as soon as the reader's thread is late by a fraction of a millisecond, as it is
beside a segmentation that uses all processors, and best effort loses the whole message. Nothing a reader sets
can enlarge that memory; but a reader that offers UDP alone is written to by UDP, and the buffer of its own
socket holds a whole cloud until its thread comes round to it.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

SOCKET_BYTES = 4 << 20
PROFILE = "config/fastdds_large_messages.xml"
# Whoever sets one of these has chosen a transport.
_CHOSEN = (
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
)
_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")


def prepare_transport(environment: MutableMapping[str, str], rmem_max: int | None = None) -> bool:
    """Receive by UDP with a socket buffer of 4 MB, where that is better and nobody chose otherwise.

    Parameters
    ----------
    environment : changed in place; `os.environ` before `rclpy.init`
    rmem_max : largest socket buffer that the system grants, in bytes; None: ask the system

    Returns
    -------
    True if the transport was set here.
    """
    granted = socket_limit() if rmem_max is None else rmem_max
    chosen = any(environment.get(name) for name in _CHOSEN)
    fast_dds = environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") == "rmw_fastrtps_cpp"
    # rmw_fastrtps lays its own transports over everything where discovery is limited to this host.
    local = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    if chosen or not fast_dds or local or granted < SOCKET_BYTES:
        return False
    environment["FASTDDS_BUILTIN_TRANSPORTS"] = f"UDPv4?max_msg_size=65500B&sockets_size={SOCKET_BYTES}B"
    return True


def socket_limit() -> int:
    """Largest receive buffer that the system grants a socket, in bytes; 0 where it does not tell."""
    try:
        return int(_RMEM_MAX.read_text())
    except (OSError, ValueError):
        return 0


def remedy(environment: MutableMapping[str, str]) -> str:
    """What helps where large messages are lost, in words for the log and the diagnostics."""
    text = f"start driver and node with FASTRTPS_DEFAULT_PROFILES_FILE=.../{PROFILE}"
    if not any(environment.get(name) for name in _CHOSEN) and socket_limit() < SOCKET_BYTES:
        text += f", or raise net.core.rmem_max to {SOCKET_BYTES} for the node alone"
    return text
