"""Bytes as all output has them: in GiB and MiB, by powers of 1024."""

MIB, GIB = 2**20, 2**30


def bytes_in_words(count: float) -> str:
    """So many bytes: whole MiB, from one GiB on GiB to a tenth."""
    return f"{count / GIB:.1f} GiB" if count >= GIB else f"{count / MIB:.0f} MiB"
