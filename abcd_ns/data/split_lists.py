"""Which views are trained on and which are held out, where the data say so themselves.

nerfstudio's readers know two forms: train_list.txt, test_list.txt and val_list.txt beside a COLMAP model, and
train_filenames, test_filenames and val_filenames in transforms.json.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from abcd_ns.data import OPTION
from abcd_ns.data.input_errors import InputError, Problems

SPLITS = ("train", "val", "test")
_NAMED = 3  # unknown photos that a message names; the others are counted


@dataclass(frozen=True)
class SplitLists:
    """Names of frames. The two may have some in common, and some may be in neither."""

    train: frozenset[str]
    held_out: frozenset[str]

    def rows(self, names: Sequence[str], split: str) -> list[int]:
        """Rows of `names` that belong to "train", or else to the views held out."""
        wanted = self.train if split == "train" else self.held_out
        return [row for row, name in enumerate(names) if name in wanted]


def split_lists(
    found: Mapping[str, Sequence[str]], known: Mapping[str, str], labels: Mapping[str, str]
) -> SplitLists | None:
    """The lists that there are as one split; None without any. What is held out is val and test together. If
    only one side is listed, the other is all the rest.

    Args:
        found: by split, what its list names.
        known: the name of each frame, by what lists call it.
        labels: by split, what messages call its list.
    """
    if not found:
        return None
    problems, everything = Problems(), frozenset(known.values())
    for split, names in found.items():
        unknown = [name for name in dict.fromkeys(names) if name not in known]
        if unknown:
            few = ", ".join(unknown[:_NAMED]) + (", ..." if len(unknown) > _NAMED else "")
            photos = "a photo" if len(unknown) == 1 else f"{len(unknown)} photos"
            problems.append(f"{labels[split]} names {photos} without a pose ({few}); correct the list.")
    problems.raise_if_any()
    listed = {split: frozenset(known[name] for name in names) for split, names in found.items()}
    held_out = listed.get("val", frozenset()) | listed.get("test", frozenset())
    train = listed.get("train", everything - held_out)
    if listed.keys() == {"train"}:
        held_out = everything - train
    if not (train and held_out):
        side = "hold out" if train else "train on"
        fix = f"set {OPTION}eval-mode interval"
        raise InputError(f"{next(iter(labels.values()))} leaves nothing to {side}; {fix}.")
    return SplitLists(train, held_out)


def read_list_files(data: Path, known: Mapping[str, str]) -> SplitLists | None:
    """The split of train_list.txt, val_list.txt and test_list.txt in `data`: a photo's name in each line.
    `known` is the name of each frame, by what the model calls it."""
    found, labels = {}, {}
    for split in SPLITS:
        path = data / f"{split}_list.txt"
        if path.is_file():
            try:
                lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()
            except OSError as error:
                raise InputError(f"{path} cannot be read ({error.strerror}); remove or replace it.") from None
            found[split] = [line.strip() for line in lines if line.strip()]
            labels[split] = str(path)
    return split_lists(found, {name: name for name in known.values()} | dict(known), labels)
