"""The `abcd` command: what it prints, what it returns, and what it does not import."""

import errno
import io
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from abcd_ns import __version__
from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from tests.cli.report.runs import made_up_folder


def say_hello(name: str, times: int = 1) -> int | None:
    """Say hello.

    Args:
        name: whom to greet.
    """
    print(" ".join([f"hello {name}"] * times))
    return 3 if name == "three" else None


@pytest.fixture
def greet(monkeypatch):
    """`greet("--name", "x")` runs `abcd greet --name x`, the only command there is."""
    command = cli.Command("greet", f"{__name__}:say_hello", "say hello")
    monkeypatch.setattr(cli, "COMMANDS", (command,))
    return lambda *args: cli.main(["greet", *args])


@pytest.fixture
def fail(monkeypatch):
    """`fail(error)` runs a command that ends with it."""

    def fail(error: BaseException) -> int:
        monkeypatch.setattr(cli, "run_command", Mock(side_effect=error))
        return cli.main(["greet"])

    return fail


def test_help_names_every_command_that_there_is(capsys):
    assert cli.main([]) == cli.main(["--help"]) == cli.main(["-h"]) == 0
    text = capsys.readouterr().out
    for command in cli.COMMANDS:
        assert text.count(f"  {command.name:<12}{command.help}\n") == 3
        assert callable(command.load())
    assert all(len(line) <= 100 for line in text.splitlines())
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"abcd {__version__}\n"


def test_help_is_quick_because_it_imports_nothing_heavy():
    """Nor does that of a command import what needs ten seconds."""
    code = (
        "import sys; from abcd_ns.cli import main; main.main(['--help']);"
        "print(sorted({'torch', 'tyro', 'numpy', 'nerfstudio', 'rich'} & set(sys.modules)));"
        "[command.load() for command in main.COMMANDS];"
        "print('nerfstudio.engine.trainer' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-2:] == ["[]", "False"]


def test_arguments_reach_the_function_which_sets_the_exit_code(greet, capsys):
    assert greet("--name", "moon", "--times", "2") == 0
    assert capsys.readouterr().out == "hello moon hello moon\n"
    assert greet("--name", "three") == 3
    for words, code, said in (("--help", 0, "whom to greet"), ("--nmae", 2, "--nmae")):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            greet(words)
        assert stop.value.code == code
        assert said in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (UserError("absent: no such scene; give an existing folder."), "absent: no such scene; give an ex"),
        (PermissionError(errno.EACCES, "No", "run/log.jsonl"), "run/log.jsonl cannot be used: No."),
        (OSError(errno.ENOSPC, "Full"), "The output cannot be written: Full; make room or write elsewhere."),
        (OSError(errno.EFBIG, "Large"), "The output cannot be written: Large; make room or write elsewhere."),
        (ModuleNotFoundError("no 'x'"), "abcd_ns cannot start here (ModuleNotFoundError: no 'x'): install "),
    ],
)
def test_what_a_user_can_mend_is_one_line_without_traceback(fail, capsys, error, said):
    assert fail(error) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"error: {said}")


def test_ctrl_c_says_nothing(fail, capsys):
    assert fail(KeyboardInterrupt()) == 130
    assert capsys.readouterr() == ("", "")


def test_a_reader_that_ends_early_is_no_error():
    """As in `abcd --help | head -1`."""
    command = subprocess.Popen([sys.executable, "-m", "abcd_ns.cli.main"], stdout=-1, stderr=-1)
    command.stdout.close()
    assert (command.stderr.read(), command.wait()) == (b"", 141)


def test_names_that_the_terminal_cannot_show_are_escaped(greet, monkeypatch):
    terminal = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(terminal, encoding="ascii"))
    assert greet("--name", "\u00fc") == 0
    assert terminal.getvalue() == b"hello \\xfc\n"


@pytest.mark.parametrize(
    "error",
    [ValueError("a bug"), ImportError("gone", name="abcd_ns.cli"), OSError(errno.EBADF, "Bad")],
)
def test_a_bug_keeps_its_traceback(fail, error):
    with pytest.raises(type(error)):
        fail(error)


WRONG_WORDS = [
    ("dmeo", "abcd has no command 'dmeo'; did you mean 'abcd demo'?"),
    ("--verbose", "abcd has no command '--verbose'; there are: demo, doctor,"),
    ("report absent", "absent is no run with abcd/settings.json: there is no such folder"),
    ("report photo.jpg", "photo.jpg is no run"),
    ("report outputs", "outputs is no run with abcd/settings.json: give a folder"),
    ("report run --out absent/page.html", "absent does not exist"),
    ("export absent --out scene.ply", "absent is no run with abcd/store"),
    ("export run --out absent/scene.ply", "absent does not exist; make it first"),
    ("mesh run --data photos --out scene.obj", "--out scene.obj must end in .ply"),
    ("mesh absent --data photos --out scene.ply", "absent is no run"),
    ("plan --data absent", "--data absent does not exist; give a folder with a COLMAP model"),
    ("poses absent", "absent/images does not exist"),
    ("train absent.toml", "absent.toml does not exist"),
    ("train run", "run cannot be read as TOML"),
    ("demo --out photo.jpg", "photo.jpg is a file"),
]
"""What users type by mistake, in a folder with a run, a photo and nothing else; and what is said."""


@pytest.mark.parametrize(("words", "said"), WRONG_WORDS, ids=[words for words, _ in WRONG_WORDS])
def test_what_users_get_wrong_is_one_line_that_says_what_to_give(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made_up_folder(Path("run"))
    Path("outputs").mkdir()
    Path("photo.jpg").touch()
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(words.split()) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("error: "))
    assert said in line
    assert sorted(tmp_path.rglob("*")) == before
