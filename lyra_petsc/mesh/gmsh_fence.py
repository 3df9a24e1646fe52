"""The sandbox of gmsh's process: the kernel's seccomp and Landlock, through ctypes.

Raised once gmsh and its libraries are loaded, and never lowered again: the process can start no program and
no other process, open no socket, and create, change or remove no file; it goes on writing to what is open.
With Landlock it can also read only what it needs. The list of statements (`geo_script`) is what is promised;
this is for what the list may have missed. Where the kernel permits none of it, nothing is raised.

Sources: seccomp(2), landlock(7); ``asm/unistd_64.h`` and ``asm-generic/unistd.h`` of Linux.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

PR_SET_NO_NEW_PRIVS = 38
SECCOMP_SET_MODE_FILTER = 1
SECCOMP_FILTER_FLAG_TSYNC = 1
RET_KILL_PROCESS, RET_ERRNO, RET_ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
LOAD, EQUAL, ANY_BIT, AT_LEAST, RETURN = 0x20, 0x15, 0x45, 0x35, 0x06
NUMBER, ARCHITECTURE = 0, 4
X32_BIT = 0x40000000
CLONE_THREAD = 0x10000
TIOCSTI, TIOCLINUX = 0x5412, 0x541C

# O_WRONLY, O_RDWR, O_CREAT, O_TRUNC, __O_TMPFILE: the same on both machines
WRITING = 0o1 | 0o2 | 0o100 | 0o1000 | 0o20000000

_AUDIT = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# since Linux 5.0 new calls have one number on all machines
_COMMON = {
    "pidfd_send_signal": 424, "io_uring_setup": 425, "io_uring_enter": 426, "io_uring_register": 427,
    "open_tree": 428, "move_mount": 429, "fsopen": 430, "fsconfig": 431, "fsmount": 432, "fspick": 433,
    "pidfd_open": 434, "clone3": 435, "openat2": 437, "pidfd_getfd": 438, "mount_setattr": 442,
    "memfd_secret": 447, "fchmodat2": 452, "setxattrat": 463, "removexattrat": 466, "file_setattr": 469,
}  # fmt: skip

_CALLS: dict[str, dict[str, int]] = {
    "x86_64": _COMMON | {
        "open": 2, "openat": 257, "clone": 56, "kill": 62, "tgkill": 234, "ioctl": 16, "prlimit64": 302,
        "seccomp": 317, "execve": 59, "execveat": 322, "fork": 57, "vfork": 58, "socket": 41, "connect": 42,
        "accept": 43, "bind": 49, "listen": 50, "socketpair": 53, "accept4": 288, "creat": 85,
        "truncate": 76, "ftruncate": 77, "fallocate": 285, "rename": 82, "renameat": 264, "renameat2": 316,
        "unlink": 87, "unlinkat": 263, "rmdir": 84, "mkdir": 83, "mkdirat": 258, "mknod": 133,
        "mknodat": 259, "link": 86, "linkat": 265, "symlink": 88, "symlinkat": 266, "chmod": 90,
        "fchmod": 91, "fchmodat": 268, "chown": 92, "fchown": 93, "lchown": 94, "fchownat": 260,
        "utime": 132, "utimes": 235, "futimesat": 261, "utimensat": 280, "setxattr": 188, "lsetxattr": 189,
        "fsetxattr": 190, "removexattr": 197, "lremovexattr": 198, "fremovexattr": 199,
        "name_to_handle_at": 303, "open_by_handle_at": 304, "io_setup": 206, "io_submit": 209,
        "ptrace": 101, "process_vm_readv": 310, "process_vm_writev": 311, "kcmp": 312, "tkill": 200,
        "rt_sigqueueinfo": 129, "rt_tgsigqueueinfo": 297, "mount": 165, "umount2": 166, "pivot_root": 155,
        "chroot": 161, "unshare": 272, "setns": 308, "init_module": 175, "finit_module": 313,
        "delete_module": 176, "kexec_load": 246, "kexec_file_load": 320, "bpf": 321, "perf_event_open": 298,
        "userfaultfd": 323, "add_key": 248, "request_key": 249, "keyctl": 250, "swapon": 167,
        "swapoff": 168, "reboot": 169, "sethostname": 170, "setdomainname": 171, "acct": 163,
        "quotactl": 179, "settimeofday": 164, "clock_settime": 227, "adjtimex": 159, "clock_adjtime": 305,
        "iopl": 172, "ioperm": 173, "syslog": 103, "shmget": 29, "shmat": 30, "semget": 64, "msgget": 68,
        "mq_open": 240, "memfd_create": 319, "fanotify_init": 300, "personality": 135, "modify_ldt": 154,
    },
    "aarch64": _COMMON | {
        "openat": 56, "clone": 220, "kill": 129, "tgkill": 131, "ioctl": 29, "prlimit64": 261,
        "seccomp": 277, "execve": 221, "execveat": 281, "socket": 198, "socketpair": 199, "bind": 200,
        "listen": 201, "accept": 202, "connect": 203, "accept4": 242, "truncate": 45, "ftruncate": 46,
        "fallocate": 47, "renameat": 38, "renameat2": 276, "unlinkat": 35, "mkdirat": 34, "mknodat": 33,
        "linkat": 37, "symlinkat": 36, "fchmod": 52, "fchmodat": 53, "fchown": 55, "fchownat": 54,
        "utimensat": 88, "setxattr": 5, "lsetxattr": 6, "fsetxattr": 7, "removexattr": 14,
        "lremovexattr": 15, "fremovexattr": 16, "name_to_handle_at": 264, "open_by_handle_at": 265,
        "io_setup": 0, "io_submit": 2, "ptrace": 117, "process_vm_readv": 270, "process_vm_writev": 271,
        "kcmp": 272, "tkill": 130, "rt_sigqueueinfo": 138, "rt_tgsigqueueinfo": 240, "mount": 40,
        "umount2": 39, "pivot_root": 41, "chroot": 51, "unshare": 97, "setns": 268, "init_module": 105,
        "finit_module": 273, "delete_module": 106, "kexec_load": 104, "kexec_file_load": 294, "bpf": 280,
        "perf_event_open": 241, "userfaultfd": 282, "add_key": 217, "request_key": 218, "keyctl": 219,
        "swapon": 224, "swapoff": 225, "reboot": 142, "sethostname": 161, "setdomainname": 162, "acct": 89,
        "quotactl": 60, "settimeofday": 170, "clock_settime": 112, "adjtimex": 171, "clock_adjtime": 266,
        "syslog": 116, "shmget": 194, "shmat": 196, "semget": 190, "msgget": 186, "mq_open": 180,
        "memfd_create": 279, "fanotify_init": 262, "personality": 92,
    },
}  # fmt: skip

# allowed or not by their arguments, below
_LOOKED_AT = ("open", "openat", "clone", "kill", "tgkill", "ioctl", "prlimit64", "seccomp")
# libraries go on with the older call when they are told that there is no such call
_UNKNOWN = ("clone3", "openat2", "io_uring_setup", "io_uring_enter", "io_uring_register")

_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""Rights over files, by the version of Landlock that brought them."""


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_ushort),
        ("jt", ctypes.c_ubyte),
        ("jf", ctypes.c_ubyte),
        ("k", ctypes.c_uint),
    )


class _Program(ctypes.Structure):
    _fields_ = (("len", ctypes.c_ushort), ("filter", ctypes.POINTER(_Instruction)))


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def raise_fence(readable: Iterable[str | os.PathLike[str]] | None) -> list[str]:
    """Drop all rights that gmsh does not need, for all threads of this process, irrevocably.

    Parameters
    ----------
    readable : iterable of path, or None
        Beneath which files may be read, where Landlock is; None: everywhere.

    Returns
    -------
    list of str
        What stands: ``seccomp``, ``Landlock``; empty where the kernel permits neither.
    """
    if sys.platform != "linux" or sys.byteorder != "little" or ctypes.sizeof(ctypes.c_void_p) != 8:
        return []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, *map(ctypes.c_ulong, (1, 0, 0, 0))) != 0:
        return []
    landlock = _landlock(libc, ["/"] if readable is None else readable)
    stands = ["seccomp"] if _seccomp(libc) else []
    return stands + (["Landlock"] if landlock else [])


def in_words(stands: Sequence[str], *, trusted: bool = False) -> str:
    """How gmsh is sandboxed, in words for the user."""
    first = (
        "scripts are trusted, whatever they say" if trusted else "scripts are read by a list of statements"
    )
    second = f"{' and '.join(stands)} in gmsh's process" if stands else "none by the kernel here"
    return f"{first}; {second}"


@cache
def standing() -> list[str]:
    """Which parts of the sandbox this system supports, tried in a process like gmsh's."""
    code = "import json, lyra_petsc.mesh.gmsh_fence as fence; print(json.dumps(fence.raise_fence(None)))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry or os.getcwd() for entry in sys.path)}
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=60,
        )
        found: list[str] = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return found


# -- seccomp -----------------------------------------------------------------------------------------


def _seccomp(libc: ctypes.CDLL) -> bool:
    machine = platform.machine()
    if machine not in _CALLS:
        return False
    lines = filter_program(machine, os.getpid())
    instructions = [_Instruction(*line) for line in lines]
    program = _Program(len(lines), (_Instruction * len(lines))(*instructions))
    call, mode, flags = _CALLS[machine]["seccomp"], SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC
    numbers = map(ctypes.c_long, (call, mode, flags))
    return bool(libc.syscall(*numbers, ctypes.byref(program)) == 0)


def filter_program(machine: str, pid: int) -> list[tuple[int, int, int, int]]:
    """The filter as classic BPF instructions (code, jump if true, jump if false, constant).

    Parameters
    ----------
    machine : str
        ``x86_64`` or ``aarch64``.
    pid : int
        The process that may be signalled: this one, by ``abort``.
    """
    calls = _CALLS[machine]
    refuse, unknown = (RET_ERRNO | number for number in (errno.EPERM, errno.ENOSYS))
    lines = [
        (LOAD, 0, 0, ARCHITECTURE),
        (EQUAL, 1, 0, _AUDIT[machine]),
        (RETURN, 0, 0, RET_KILL_PROCESS),
        (LOAD, 0, 0, NUMBER),
    ]
    if machine == "x86_64":
        lines += [(AT_LEAST, 0, 1, X32_BIT), (RETURN, 0, 0, refuse)]
    for name, number in calls.items():
        if name not in _LOOKED_AT:
            answer = unknown if name in _UNKNOWN else refuse
            lines += [(EQUAL, 0, 1, number), (RETURN, 0, 0, answer)]

    def looked_at(name: str, argument: int, *tests: tuple[int, int], passes: bool) -> None:
        """``passes``: whether a test that holds lets the call through, or refuses it."""
        if name not in calls:
            return
        then, otherwise = (RET_ALLOW, refuse) if passes else (refuse, RET_ALLOW)
        body = [(LOAD, 0, 0, 16 + 8 * argument)]
        for code, value in tests:
            body += [(code, 0, 1, value), (RETURN, 0, 0, then)]
        body.append((RETURN, 0, 0, otherwise))
        lines.append((EQUAL, 0, len(body), calls[name]))
        lines.extend(body)

    looked_at("clone", 0, (ANY_BIT, CLONE_THREAD), passes=True)
    looked_at("open", 1, (ANY_BIT, WRITING), passes=False)
    looked_at("openat", 2, (ANY_BIT, WRITING), passes=False)
    looked_at("ioctl", 1, (EQUAL, TIOCSTI), (EQUAL, TIOCLINUX), passes=False)
    looked_at("kill", 0, (EQUAL, pid), passes=True)
    looked_at("tgkill", 0, (EQUAL, pid), passes=True)
    looked_at("prlimit64", 0, (EQUAL, 0), (EQUAL, pid), passes=True)
    lines.append((RETURN, 0, 0, RET_ALLOW))
    return lines


# -- Landlock ----------------------------------------------------------------------------------------


def _landlock(libc: ctypes.CDLL, readable: Iterable[str | os.PathLike[str]]) -> bool:
    long, none = ctypes.c_long, ctypes.c_void_p(None)
    version = int(libc.syscall(long(_LANDLOCK_CREATE), none, long(0), long(1)))
    if version < 1:
        return False
    rights = sum(right for since, right in _FILE_RIGHTS.items() if since <= version)
    wanted = _Ruleset(rights, 0b11 if version >= 4 else 0, 0b11 if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    ruleset = int(libc.syscall(long(_LANDLOCK_CREATE), ctypes.byref(wanted), long(size), long(0)))
    if ruleset < 0:
        return False
    try:
        for path in readable:
            try:
                parent = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:  # not there
                continue
            try:
                allowed = _READ_FILE | (_READ_DIR if Path(path).is_dir() else 0)
                rule = _Beneath(allowed, parent)
                libc.syscall(long(_LANDLOCK_ADD), long(ruleset), long(1), ctypes.byref(rule), long(0))
            finally:
                os.close(parent)
        return int(libc.syscall(long(_LANDLOCK_RESTRICT), long(ruleset), long(0))) == 0
    finally:
        os.close(ruleset)
