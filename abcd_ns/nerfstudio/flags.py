"""Which options of a config class stand on the command line of `ns-train`, and how they are named."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_type_hints

import tyro


def hidden(*names: str) -> Callable[[type], type]:
    """Of a config class, above `@dataclass`: these fields are no flags; files and Python may set them."""

    def decorate(cls: type) -> type:
        hints = get_type_hints(cls, include_extras=True)
        return _annotate(cls, {name: tyro.conf.Suppress[hints[name]] for name in names})

    return decorate


def named_too(cls: type, flags: Mapping[str, str]) -> None:
    """Give fields of a config class a second flag each, by the field's name."""
    hints = get_type_hints(cls, include_extras=True)
    second = {name: tyro.conf.arg(aliases=[flag]) for name, flag in flags.items()}
    _annotate(cls, {name: Annotated[hints[name], also] for name, also in second.items()})


def _annotate(cls: type, annotations: dict[str, Any]) -> type:
    # tyro reads annotations when it makes its command line; the class itself stays as it was.
    cls.__annotations__ = {**cls.__annotations__, **annotations}
    return cls
