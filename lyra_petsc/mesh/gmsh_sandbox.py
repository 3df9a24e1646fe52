"""Sandbox of the process in which gmsh and other libraries read meshes: seccomp (by libseccomp) and Landlock
of the Linux kernel, through ctypes.

The process enters the sandbox once the library is loaded, and cannot leave it. An attempt to start a program
or a process then ends it (SIGSYS). It can open no socket, and create, change or remove no file; it can write
to files that are open. With Landlock it can read only the files it needs. A mesh script is a program, and
this is all that confines it. Where the kernel permits neither, or without libseccomp (part of systemd and of
Debian's apt), the respective layer is missing.

Sources: seccomp_init(3), seccomp_rule_add(3), landlock(7).
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from lyra_petsc.startup import python_command

PR_SET_NO_NEW_PRIVS = 38
CLONE_THREAD = 0x10000
# flags of open for writing; the last is the bit of O_TMPFILE that O_DIRECTORY lacks
WRITING = (os.O_WRONLY, os.O_RDWR, os.O_CREAT, os.O_TRUNC, 0o20000000)

# constants of libseccomp: actions, attributes of a filter, comparisons
_ALLOW, _REFUSE, _UNKNOWN, _KILL = 0x7FFF0000, 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS, 0x80000000
_BAD_ARCHITECTURE, _ALL_THREADS = 2, 4
_DIFFERS, _MASKED = 1, 7

_REFUSED_CALLS = """
    accept accept4 acct add_key adjtimex bind bpf chmod chown chroot clock_adjtime clock_settime connect
    creat delete_module fallocate fanotify_init fchmod fchmodat fchown fchownat
    finit_module fremovexattr fsetxattr ftruncate futimesat init_module io_setup io_submit ioperm
    iopl kcmp kexec_file_load kexec_load keyctl lchown link linkat listen lremovexattr lsetxattr
    memfd_create mkdir mkdirat mknod mknodat modify_ldt mount mq_open msgget name_to_handle_at
    open_by_handle_at perf_event_open personality pivot_root process_vm_readv process_vm_writev ptrace
    quotactl reboot removexattr rename renameat renameat2 request_key rmdir rt_sigqueueinfo
    rt_tgsigqueueinfo seccomp semget setdomainname sethostname setns settimeofday setxattr shmat shmget
    socket socketpair swapoff swapon symlink symlinkat syslog tkill truncate umount2 unlink unlinkat
    unshare userfaultfd utime utimensat utimes
"""

_STARTING_CALLS = ("execve", "execveat", "fork", "vfork")

# calls that an older libseccomp does not know; since Linux 5.0 new calls have one number on all machines
_NEW_CALLS = {
    "pidfd_send_signal": 424, "open_tree": 428, "move_mount": 429, "fsopen": 430, "fsconfig": 431,
    "fsmount": 432, "fspick": 433, "pidfd_open": 434, "pidfd_getfd": 438, "mount_setattr": 442,
    "memfd_secret": 447, "fchmodat2": 452, "setxattrat": 463, "removexattrat": 466, "file_setattr": 469,
}  # fmt: skip

# answered with "no such call", so that libraries use the older call
_UNKNOWN_CALLS = {
    "io_uring_setup": 425, "io_uring_enter": 426, "io_uring_register": 427, "clone3": 435, "openat2": 437
}  # fmt: skip

_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""Access rights to files, by the version of Landlock that introduced them."""


class _Comparison(ctypes.Structure):
    """Comparison of an argument with ``first``, or of its bits in the mask ``first`` with ``second``."""

    _fields_ = (
        ("argument", ctypes.c_uint),
        ("kind", ctypes.c_int),
        ("first", ctypes.c_uint64),
        ("second", ctypes.c_uint64),
    )


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def enter_sandbox(readable: Iterable[str | os.PathLike[str]]) -> list[str]:
    """Drop all rights that gmsh does not need, for all threads of this process, irrevocably.

    Parameters
    ----------
    readable : iterable of path
        Files and folders that can be read, where the kernel has Landlock.

    Returns
    -------
    list of str
        Layers in force: ``seccomp``, ``Landlock``; empty where the kernel permits neither.
    """
    if sys.platform != "linux":
        return []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, *map(ctypes.c_ulong, (1, 0, 0, 0))) != 0:
        return []
    loaded = {"seccomp": _load_seccomp(), "Landlock": _load_landlock(libc, readable)}
    return [layer for layer, is_loaded in loaded.items() if is_loaded]


def describe_sandbox(layers: Sequence[str], *, trusted: bool = False) -> str:
    """Text for the user on what confines mesh scripts (.geo)."""
    if "seccomp" not in layers:
        return "none, as there is no seccomp" + ("" if trusted else ": scripts (.geo) need --trust-mesh")
    reads = "any file" if trusted or "Landlock" not in layers else "their folder"
    return f"{' and '.join(layers)}: scripts start no programs, write no files, and read {reads}"


@cache
def supported_layers() -> list[str]:
    """Layers of the sandbox that this system supports, determined in a child process."""
    code = "import json, lyra_petsc.mesh.gmsh_sandbox as s; print(json.dumps(s.enter_sandbox(['/'])))"
    try:
        done = subprocess.run(
            python_command(code),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=60,
        )
        layers: list[str] = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return layers


# -- seccomp -----------------------------------------------------------------------------------------


def _load_seccomp() -> bool:
    """Load the filter of system calls; whether the whole of it is in force."""
    from termios import TIOCLINUX, TIOCSTI  # Linux only

    try:
        library = ctypes.CDLL("libseccomp.so.2")
    except OSError:
        return False
    library.seccomp_init.restype = ctypes.c_void_p
    rules = ctypes.c_void_p(library.seccomp_init(_ALLOW))

    def answer(action: int, name: str, *comparison: int) -> bool:
        """Add a rule for calls of this name for which the comparison holds; whether this worked."""
        number = library.seccomp_syscall_resolve_name(name.encode())
        if number == -1:
            number = (_NEW_CALLS | _UNKNOWN_CALLS).get(name, number)
        if number < 0:  # no such call on this machine
            return True
        compared = ctypes.byref(_Comparison(*comparison)) if comparison else None
        rule = rules, ctypes.c_uint32(action), number, len(comparison[:1]), compared
        return bool(library.seccomp_rule_add_array(*rule) == 0)

    done = [
        library.seccomp_attr_set(rules, _BAD_ARCHITECTURE, ctypes.c_uint32(_KILL)) == 0,
        library.seccomp_attr_set(rules, _ALL_THREADS, 1) == 0,
        *(answer(_REFUSE, name) for name in (*_REFUSED_CALLS.split(), *_NEW_CALLS)),
        *(answer(_UNKNOWN, name) for name in _UNKNOWN_CALLS),
        *(answer(_KILL, name) for name in _STARTING_CALLS),
        answer(_KILL, "clone", 0, _MASKED, CLONE_THREAD, 0),  # threads remain allowed
        # the kernel uses the lower 32 bits of this argument
        *(answer(_REFUSE, "ioctl", 1, _MASKED, 2**32 - 1, request) for request in (TIOCSTI, TIOCLINUX)),
        *(answer(_REFUSE, name, 0, _DIFFERS, os.getpid()) for name in ("kill", "tgkill")),  # abort needs them
        answer(_REFUSE, "prlimit64", 0, _DIFFERS, 0),  # 0: this process
        *(
            answer(_REFUSE, name, number, _MASKED, bit, bit)
            for number, name in ((1, "open"), (2, "openat"))
            for bit in WRITING
        ),
    ]
    loaded = all(done) and library.seccomp_load(rules) == 0
    library.seccomp_release(rules)
    return bool(loaded)


# -- Landlock ----------------------------------------------------------------------------------------


def _load_landlock(libc: ctypes.CDLL, readable: Iterable[str | os.PathLike[str]]) -> bool:
    """Restrict reading to ``readable`` and forbid writing; whether it is in force."""
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
            except OSError:  # does not exist
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
