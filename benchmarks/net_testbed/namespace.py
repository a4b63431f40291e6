"""Create, enter and connect network namespaces of Linux by system calls.

This needs root, or permission for user namespaces.
"""

import ctypes
import fcntl
import os
import socket
import struct
from pathlib import Path

_CLONE_NEWUSER, _CLONE_NEWNET = 0x1000_0000, 0x4000_0000  # linux/sched.h
_SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCSIFFLAGS, _SIOCSIFMTU = 0x8916, 0x891C, 0x8914, 0x8922  # linux/sockios.h
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h
_IFF_UP_RUNNING = 0x1 | 0x40
_NETMASK = "255.255.255.0"
MTU = 1400  # [bytes]


class NetTestbedError(OSError):
    """Two machines cannot be emulated here; the text has the reason and a remedy."""


def leave_user() -> None:
    """Become root of a new user namespace if this process is not root.

    The process must have one thread.

    Raises:
        NetTestbedError: The system does not allow it.
    """
    if os.geteuid() == 0:
        return
    user, group = os.geteuid(), os.getegid()
    _call("unshare", _CLONE_NEWUSER)
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1", encoding="ascii")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1", encoding="ascii")


def leave_network() -> None:
    """Enter a new network namespace with only a loopback device.

    Raises:
        NetTestbedError: The system does not allow it.
    """
    _call("unshare", _CLONE_NEWNET)
    _bring_up("lo")


def enter(pid: int) -> None:
    """Enter the network namespace of a process.

    Its user namespace is entered first if that differs.

    Raises:
        NetTestbedError: The process has ended, or the system does not allow it.
    """
    try:
        if not Path(f"/proc/{pid}/ns/user").samefile("/proc/self/ns/user"):
            _set(f"/proc/{pid}/ns/user", _CLONE_NEWUSER)
        _set(f"/proc/{pid}/ns/net", _CLONE_NEWNET)
    except FileNotFoundError:
        raise NetTestbedError(f"process {pid}, whose network namespace is needed, has ended") from None


def wire(name: str, address: str) -> int:
    """Create a device with an IPv4 address in this network namespace.

    Return a file: its reads and writes are the device's packets. It stays connected to that device if the process enters
    another namespace.

    Raises:
        NetTestbedError: The system does not allow it.
    """
    try:
        file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
            fcntl.ioctl(to, _SIOCSIFADDR, _request(name, _inet(address)))
            fcntl.ioctl(to, _SIOCSIFNETMASK, _request(name, _inet(_NETMASK)))
            fcntl.ioctl(to, _SIOCSIFMTU, _request(name, struct.pack("i", MTU)))
    except OSError as error:
        raise NetTestbedError(
            f"cannot create a TUN device ({error}); check that /dev/net/tun exists (`modprobe tun`) and this user may open it"
        ) from error
    _bring_up(name)
    return file


def _bring_up(name: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
        fcntl.ioctl(to, _SIOCSIFFLAGS, _request(name, struct.pack("h", _IFF_UP_RUNNING)))


def _request(name: str, value: bytes) -> bytes:
    """Return a request of linux/if.h: the name and the value."""
    return struct.pack("16s24s", name.encode(), value)


def _inet(address: str) -> bytes:
    return struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(address))


def _set(path: str, kind: int) -> None:
    file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _call("setns", file, kind)
    finally:
        os.close(file)


def _call(name: str, *arguments: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) != 0:
        why = os.strerror(ctypes.get_errno())
        raise NetTestbedError(
            f"{name} of a namespace: {why}; run this as root, or allow user namespaces (kernel.unprivileged_userns_clone=1, "
            "and on Ubuntu kernel.apparmor_restrict_unprivileged_userns=0)"
        )
