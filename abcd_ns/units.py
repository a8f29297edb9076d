"""Bytes as all output has them: in GiB and MiB, by powers of 1024."""

MIB, GIB = 2**20, 2**30


def bytes_in_words(count: float) -> str:
    """So many bytes: GiB to a tenth, whole MiB, or below ten of them two digits."""
    if count >= GIB:
        return f"{count / GIB:.1f} GiB"
    return f"{count / MIB:.0f} MiB" if count >= 9.95 * MIB else f"{count / MIB:.2g} MiB"
