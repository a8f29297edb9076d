"""A signal ends a run between two steps, and the line that says how to go on is one that can be typed."""

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from abcd_ns.nerfstudio.run.stopping import StopSignals, command_to_resume, next_steps


def test_handlers_are_put_back():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with StopSignals():
        assert signal.getsignal(signal.SIGTERM) not in before
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (
            "/venv/bin/ns-train abcd --data wall --vis viewer colmap --downscale 2",
            "ns-train abcd --load-dir 'my run' --data wall --vis viewer colmap --downscale 2",
        ),
        (
            "ns-train abcd --load-dir older --load_step 7 --data wall",
            "ns-train abcd --load-dir 'my run' --data wall",
        ),
        ("ns-train abcd --load-dir=older --data wall", "ns-train abcd --load-dir 'my run' --data wall"),
        ("/venv/lib/abcd_ns/lab/runs/worker.py job.json", None),
        ("ns-train abcd-paper --data wall", None),
        ("ns-train abcd --load_config=mine.yml", None),
    ],
)
def test_the_command_to_go_on_keeps_the_options(argv, expected):
    assert command_to_resume(argv.split(), "abcd", Path("my run")) == expected


def test_what_is_next_are_commands_about_the_run():
    argv = ["/usr/bin/ns-train", "abcd", "--max_num_iterations", "1000", "--data", "wall"]
    longer = command_to_resume(argv, "abcd", Path("my run/m"), ("--max-num-iterations", "2000"))
    lines = next_steps(Path("my run"), Path("wall"), longer).splitlines()
    assert "    abcd report 'my run' --data wall" in lines
    assert "    ns-viewer --load-config 'my run/config.yml'" in lines
    assert lines[-1] == "    ns-train abcd --load-dir 'my run/m' --max-num-iterations 2000 --data wall"
    assert "Train" not in next_steps(Path("run"), Path("wall"), None)


def test_in_another_thread_signals_stay_as_they_are():
    def handler() -> object:
        with StopSignals():
            return signal.getsignal(signal.SIGTERM)

    with ThreadPoolExecutor(1) as other:
        assert other.submit(handler).result() == signal.getsignal(signal.SIGTERM)
