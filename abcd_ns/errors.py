"""The one error that is the user's to mend, how full RAM looks, what is said where packages are missing."""


class UserError(Exception):
    """Something the user gave can't be used; the message says what, and what to do about it.

    The command line prints the message alone, without a traceback. Derive from this class for every
    error that a user can cause; any other exception that reaches the command line is a bug of ours.
    """


def is_out_of_memory(error: BaseException) -> bool:
    """Whether RAM was full, which others take and give back. Torch says so by a RuntimeError."""
    return isinstance(error, MemoryError) or "DefaultCPUAllocator: can't allocate memory" in str(error)


def first_line(error: BaseException) -> str:
    """Of what it says, or else its kind."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


IMPORT_TROUBLE = (ImportError, OSError, RuntimeError, AttributeError, TypeError, ValueError)
"""What imports end with where packages or system libraries are missing or do not fit together."""


def missing(error: Exception) -> str:
    """What to tell a user whose import of this package ended with one of IMPORT_TROUBLE."""
    what = f"abcd_ns cannot start here ({type(error).__name__}: {error})"
    if getattr(error, "name", None) == "fcntl":
        return f"{what}: it needs Linux or macOS."
    return f"{what}: install it again, by pip install in this environment; `abcd doctor` looks closer."
