"""Locks on open files: of one process at a time, and gone with it, however it ends."""

import errno

try:
    import fcntl
except ImportError:  # Windows.
    fcntl = None

NOT_SUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}


def try_lock(file) -> bool:
    """Take the lock of an open file. False if another process has it. Raises `OSError` where there are no locks."""
    if fcntl is None:
        raise OSError(errno.ENOSYS, "no locks on this platform")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def has_no_locks(error: OSError) -> bool:
    """Whether an error of `try_lock` says that the platform or the file system knows no locks."""
    return error.errno in NOT_SUPPORTED
