"""The panel of blocks in nerfstudio's viewer, while a run trains (ns-train) and afterwards (ns-viewer)."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import psutil
import torch
import viser
import viser.transforms as vtf
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from abcd_ns.engine import events
from abcd_ns.engine.space.influence import worth_training
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.train.run_state import UNLIMITED, RunState
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import View
from abcd_ns.terminal import many
from abcd_ns.viewer import texts
from abcd_ns.viewer.guard import rules_of
from abcd_ns.viewer.images import curve_image, photo_image
from abcd_ns.viewer.pictures import Choice, Show
from abcd_ns.viewer.scenery import Scenery, boxes_of, bulk, first_look, nearest_view, views_that_see

AT_ONCE = (events.VisitBegan, events.VisitEnded, events.EpochEnded, events.PrunedAtEnd)
"""Events that are shown at once; others once in SECONDS_BETWEEN_UPDATES."""
SECONDS_BETWEEN_UPDATES = 1.0
SECONDS_BETWEEN_CURVES = 10.0
HANDOVER_SECONDS = 0.002
FOLLOW = "the one in training"  # the entry of the list of blocks that stands for whichever is active
CURVE = "PSNR of training crops in dB over seconds of training"
MOST_POINTS = 2000  # Gaussians of a block that tell which cameras see it


class AbcdPanel(ViewerControl):
    """Shows where a run stands, and lets the user choose what is drawn of `model`, an AbcdModel. `views`
    returns the training views, `photo` that of a view by its index, uint8 [h, w, c].

    nerfstudio finds it as an attribute of the pipeline and calls `_setup`. All else happens under the
    training lock: events come from the training thread, which holds it, and the user's choices take it.
    """

    def __init__(self, model: Any, views: Callable[[], list[View]], photo: Callable[[int], Tensor]) -> None:
        self._model, self._views, self._photo = model, views, photo
        self._coordinator: Trainer | None = None
        self._log: Any = None
        self._controls: Controls | None = None
        self._scenery: Scenery | None = None
        self._cameras_of: int | None = None
        self._photo_of: int | None = None
        self._stage = ""  # what is done between steps
        self._workers: tuple[events.WorkerSeen, ...] = ()
        self._over = False
        self._laid_out = 0  # blocks that have boxes and entries in the list
        self._bounds: Box | None = None
        self._training_views: list[View] = []
        self._updated = self._curve_drawn = 0.0

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        share, server = viewer.config.make_share_url, viewer.viser_server
        if (rules := rules_of(server)) is not None:
            rules.share = share
        if not share and (line := texts.reach(viewer.config.websocket_host)) is not None:
            CONSOLE.print(line, highlight=False)
        # nerfstudio's title bar fetches a picture from its site; viser's offers everyone a public tunnel.
        look = {"control_layout": "collapsible", "dark_mode": True, "brand_color": (255, 211, 105)}
        server.gui.configure_theme(**look, show_share_button=share)
        trains = viewer.trainer is not None
        self._controls = Controls(server.gui, viewer.stats_markdown.order + 0.5, self._choose, trains)
        self._scenery = Scenery(server.scene, viewer.config.camera_frustum_scale)
        if not trains:
            self._lay_out()
            self._update()

    def follow(self, coordinator: Trainer, log: Any) -> None:
        """Show how a run goes, and the `visits` and `curve` of its RunLog."""
        self._coordinator, self._log = coordinator, log
        if self._controls is not None:
            self._lay_out()
            coordinator.announce.subscribe(self)
            self._update()

    def __call__(self, event: events.Event) -> None:
        if isinstance(event, events.WorkersSeen):
            self._workers = event.workers
        names = {events.LayersDrawn: "layers", events.Pruning: "final pruning"}
        self._stage = f"{names[type(event)]} {event.done} of {event.total}" if type(event) in names else ""
        due = time.monotonic() - self._updated > SECONDS_BETWEEN_UPDATES
        if due or isinstance(event, AT_ONCE):
            self._update()
        if isinstance(event, events.WorkersSeen) or (due and self._stage):
            self._let_viewer_draw()

    def _let_viewer_draw(self) -> None:
        """Release the training lock for one picture: layers and workers take long, and browsers wait."""
        lock = self.viewer.train_lock
        if lock is None or not lock.locked() or not self.viewer.render_statemachines:
            return
        lock.release()
        try:
            time.sleep(HANDOVER_SECONDS)  # or this thread would have it back before another one wakes up
        finally:
            lock.acquire()

    def _lay_out(self) -> None:
        """Make boxes and the list of blocks anew, as the tree is cut now."""
        tree, scene = self._model.tree, self._model.scene()
        if self._bounds is None:  # once: every block is read for it, and one may be on the device
            means = [scene.gaussians(block).means.cpu() for block in range(tree.num_blocks)]
            self._bounds = bulk(torch.cat(means))
        self._scenery.set_boxes(boxes_of(tree, self._bounds))
        self._training_views = self._views()
        self._first_look = first_look(self._bounds, self._training_views)
        self._controls.set_blocks(tree.num_blocks)
        if not self._laid_out:  # calls it for browsers that are there already, too
            self.viewer.viser_server.on_client_connect(self._welcome)
        self._laid_out = tree.num_blocks

    def _update(self) -> None:
        if not self._laid_out:
            return
        if self._laid_out != self._model.tree.num_blocks:  # a block was split
            self._lay_out()
        self._updated = time.monotonic()
        rows = self._rows()
        self._controls.write(blocks=texts.block_table(rows), memory=texts.memory_table(self._memory()))
        self._scenery.show_boxes({row.block: row.status for row in rows}, self._controls.boxes.value)
        self._show_cameras()
        if self._coordinator is not None:
            self._report(self._coordinator)

    def _report(self, coordinator: Trainer) -> None:
        state, left = coordinator.state, texts.clock(texts.time_left(coordinator))
        headline = f"**{self._where(state)}**  \n{coordinator.progress:.0%} of the run, {left} left"
        waiting = many(len(state.queue), "visit is", "visits are")
        epoch = f"Epoch {state.epoch}: {waiting} waiting" if state.queue else ""
        if coordinator.finished and not self._stage:
            headline, epoch = "**Trained.**", ""
            if not self._over:
                self._over, self._controls.boxes.value = True, False  # they were about the training
        self._controls.write(headline=headline, epoch=epoch)
        self._controls.bar.value = round(100 * min(coordinator.progress, 1.0), 1)
        self.viewer.update_step(state.step)  # nerfstudio's own stands still between pictures
        due = self._updated - self._curve_drawn > SECONDS_BETWEEN_CURVES
        if coordinator.finished or (due and self.viewer.viser_server.get_clients()):
            self._curve_drawn = self._updated
            self._controls.write(curve=curve_image(self._log.curve, CURVE))

    def _where(self, state: RunState) -> str:
        active = state.active
        if active is None and self._workers and not self._stage:
            return "  \n".join(map(texts.worker_line, self._workers))
        if active is None and self._coordinator.config.recipe.exact:
            return "All blocks at once"
        if active is None:
            return self._stage.capitalize() or "Between visits"
        steps = f" of {active.steps}" if 0 < active.steps < UNLIMITED else ""
        step = self._stage or f"step {active.done}{steps}"
        if active.is_whole:
            return f"Warm-up of the whole scene, {step}"
        return f"Block {active.geometry.block + 1}, {step}"

    def _rows(self) -> list[texts.BlockRow]:
        scene, blocks = self._model.scene(), range(self._model.tree.num_blocks)
        if self._coordinator is None:
            state = (texts.Status.UNTRAINED, texts.Status.DONE)
            return [texts.BlockRow(b, state[scene.count(b) > 0], scene.count(b)) for b in blocks]
        if self._coordinator.config.recipe.exact:
            return [texts.BlockRow(b, texts.Status.ACTIVE) for b in blocks]
        state, active = self._coordinator.state, self._active()
        psnrs = {visit.block: visit.psnr for visit in self._log.visits[self._log.renumbered :]}
        counts = [None if state.active and state.active.is_whole else scene.count(b) for b in blocks]
        return [
            texts.BlockRow(b, texts.status_of(b, state, active), counts[b], psnrs.get(b), state.views.get(b))
            for b in blocks
        ]

    def _active(self) -> list[int]:
        state = self._coordinator.state
        if state.active is not None:
            return [] if state.active.is_whole else [state.active.geometry.block]
        in_flight = {visit.geometry.block for visit in state.in_flight}
        return [worker.block for worker in self._workers if worker.block in in_flight]

    def _memory(self) -> list[tuple[str, int, int]]:
        rows = [("RAM", psutil.Process().memory_info().rss, psutil.virtual_memory().total)]
        if torch.cuda.is_available():
            total = torch.cuda.get_device_properties(0).total_memory
            rows.append(("GPU, most so far", torch.cuda.max_memory_allocated(), total))
        if self._coordinator is not None:
            rows.append(("layers", self._coordinator.layer_bytes, self._coordinator.layer_limit))
        return rows

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Place a new browser's camera so that it sees the scene."""
        client.camera.position, client.camera.look_at = self._first_look
        client.camera.on_update(lambda _: self._show_photo(client))

    def _choose(self) -> None:
        with self.viewer.train_lock or nullcontext():
            self._model.choice = self._controls.choice
            self._cameras_of = self._photo_of = None
            self._update()
        for client in self.viewer.viser_server.get_clients().values():
            self._show_photo(client)
        self.viewer._trigger_rerender()

    def _show_photo(self, client: viser.ClientHandle) -> None:
        """Show the photo of the training view nearest to a browser's camera, if that is wanted."""
        view = None
        if self._controls.photo.value:
            forward = vtf.SO3(client.camera.wxyz).as_matrix()[:, 2]
            view = nearest_view(client.camera.position, forward, self._training_views)
        if view is None:
            self._controls.write(photo="")
        elif view.index != self._photo_of:
            self._photo_of = view.index
            name = f"Training photo {view.index + 1}"
            self._controls.write(photo=f"{photo_image(self._photo(view.index).numpy(), name)}  \n{name}")

    def _show_cameras(self) -> None:
        block = self._model.choice.block
        if block is None and self._coordinator is not None:
            block = next(iter(self._active()), None)
        if not self._controls.cameras.value:
            block = None
        if block != self._cameras_of or block is None:
            self._scenery.show_cameras([] if block is None else self._views_of(block))
        self._cameras_of = block

    def _views_of(self, block: int) -> list[View]:
        """The views that the block is trained on; those that see it where that is unknown."""
        if self._coordinator is not None and block in self._coordinator.state.influence:
            known = self._coordinator.state.influence[block]
            kept = worth_training(known, self._coordinator.config.recipe.influence_share)
            return [self._coordinator.views[index] for index in kept]
        means = self._model.scene().gaussians(block).means
        return views_that_see(means[:: max(len(means) // MOST_POINTS, 1)], self._training_views)


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
                self.bar = gui.add_progress_bar(0.0)
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
    def choice(self) -> Choice:
        block = None if self._block.value == FOLLOW else int(self._block.value) - 1
        return Choice(Show(self._show.value), block)

    def set_blocks(self, count: int) -> None:
        names = tuple(str(block + 1) for block in range(count))
        self._block.options = (FOLLOW, *names) if self._trains else names

    def write(self, **texts: str) -> None:
        """Set texts: headline, epoch, photo, blocks, memory, curve."""
        for name, text in texts.items():
            if self._texts[name].content != text:
                self._texts[name].content = text
