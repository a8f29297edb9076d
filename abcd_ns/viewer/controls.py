"""The panel's controls in the browser, by the calls that viser 0.2 and 1 have in common."""

from collections.abc import Callable
from pathlib import Path

import viser

from abcd_ns.viewer.images import curve_image
from abcd_ns.viewer.pictures import Show

FOLLOW = "the one in training"  # the entry of the list of blocks that stands for whichever is active
CURVE = "PSNR of training crops in dB over seconds of training"


class Controls:
    """A folder of controls, at `order` in the sidebar; texts are sent only when they change. `changed` is
    called in a thread of viser's when the user has chosen something. `trains` is whether a run is under way;
    else a finished scene is shown."""

    def __init__(self, gui: viser.GuiApi, order: float, changed: Callable[[], None], trains: bool) -> None:
        self._trains = trains
        self._texts: dict[str, viser.GuiMarkdownHandle] = {}
        with gui.add_folder("Blocks (ABCD)", order=order):
            if trains:
                self._texts["headline"] = gui.add_markdown("Training has not begun.")
                self._run = gui.add_progress_bar(0.0)
                self._texts["epoch"] = gui.add_markdown("")
            self._show = gui.add_dropdown("Show", options=tuple(show.value for show in Show))
            self._block = gui.add_dropdown("Block", options=(FOLLOW,) if trains else ("1",))
            self.boxes = gui.add_checkbox("Boxes", initial_value=trains)
            self.cameras = gui.add_checkbox("Its cameras", initial_value=False)
            self.photo = gui.add_checkbox("Nearest photo", initial_value=False)
            # A root for pictures' files, which viser asks for although there are none.
            self._texts["photo"] = gui.add_markdown("", image_root=Path())
            with gui.add_folder("Table", expand_by_default=True):
                self._texts["blocks"] = gui.add_markdown("")
            with gui.add_folder("Memory", expand_by_default=trains):
                self._texts["memory"] = gui.add_markdown("")
            if trains:
                with gui.add_folder("Accuracy over time", expand_by_default=True):
                    self._texts["curve"] = gui.add_markdown(curve_image([], CURVE), image_root=Path())
                    gui.add_markdown(CURVE)
        for handle in (self._show, self._block, self.boxes, self.cameras, self.photo):
            handle.on_update(lambda _: changed())

    @property
    def show(self) -> Show:
        """What is to be drawn."""
        return Show(self._show.value)

    @property
    def block(self) -> int | None:
        """The chosen block; None for the one in training."""
        return None if self._block.value == FOLLOW else int(self._block.value) - 1

    def set_blocks(self, count: int) -> None:
        """Offer that many blocks for choice."""
        names = tuple(str(block + 1) for block in range(count))
        self._block.options = (FOLLOW, *names) if self._trains else names

    def write(self, **texts: str) -> None:
        """Set texts: headline, epoch, photo, blocks, memory, curve."""
        for name, text in texts.items():
            if self._texts[name].content != text:
                self._texts[name].content = text

    def progress(self, share: float) -> None:
        """Move the bar; 0..1."""
        value = round(100 * min(share, 1.0), 1)
        if self._run.value != value:
            self._run.value = value
