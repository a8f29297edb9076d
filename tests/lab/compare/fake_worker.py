"""A worker process that trains nothing: it makes runs up, and does what a test tells it."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from tests.lab.compare.records import made_up_run

WORKER = """
import json, os, pathlib, sys
path = pathlib.Path(sys.argv[1])
job = json.loads(path.read_text())
changes = job["changes"]
here = pathlib.Path(__file__).parent
with open(here / "calls.txt", "a") as calls:
    calls.write(" ".join([job["method"], *changes]) + "\\n")
print("starting")
behaviours = json.loads((here / "behaviour.json").read_text())
behaviour = behaviours.get(" ".join(changes) or job["method"])
if behaviour == "raises":
    print()
    sys.exit("ValueError: the scene is empty\\n")
if behaviour == "is killed":
    os.kill(os.getpid(), 9)
if behaviour == "is silent":
    sys.exit(0)
run = json.loads((here / "run.json").read_text())
run.update(method=job["method"], seed=job["seed"])
run.update(behaviour or {})
path.with_name("run.json").write_text(json.dumps(run))
"""


class FakeWorker:
    def __init__(self, folder: Path) -> None:
        self.folder, self.command = folder, (sys.executable, str(folder / "worker.py"))
        folder.mkdir()
        (folder / "worker.py").write_text(WORKER)
        (folder / "run.json").write_text(json.dumps(asdict(made_up_run())))
        self.behave({})

    def behave(self, what: dict[str, str | dict]) -> None:
        """What to do, by what is changed or by method: "raises", "is killed", "is silent", or fields of the
        run that is made up."""
        (self.folder / "behaviour.json").write_text(json.dumps(what))

    def calls(self) -> list[str]:
        """Methods, and what was changed of them, that it was started for since the last call of this."""
        path = self.folder / "calls.txt"
        found = path.read_text().splitlines() if path.exists() else []
        path.unlink(missing_ok=True)
        return found
