"""The `abcd` command: what it prints, what it returns, and what it does not import."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from abcd_ns import __version__
from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from tests.cli.report.runs import made_up_folder

THERE_ARE = f"there are: {', '.join(command.name for command in cli.COMMANDS)}."


class _NoSuchScene(UserError):
    pass


def _greet(name: str, times: int = 1) -> int | None:
    """Say hello.

    Args:
        name: whom to greet.
    """
    if name == "nobody":
        raise _NoSuchScene("nobody: no such scene; give an existing folder.")
    if name == "locked":
        raise PermissionError(13, "Permission denied", "run/log.jsonl")
    if name == "ctrl-c":
        raise KeyboardInterrupt
    if name == "bug":
        raise ValueError("a bug")
    print(" ".join([f"hello {name}"] * times))
    return 3 if name == "three" else None


@pytest.fixture
def greet(monkeypatch):
    """`greet("--name", "x")` runs `abcd greet --name x`, the only command there is."""
    module = ModuleType("a_module_of_the_test")
    module.greet = _greet
    monkeypatch.setitem(sys.modules, module.__name__, module)
    command = cli.Command("greet", f"{module.__name__}:greet", "say hello")
    monkeypatch.setattr(cli, "COMMANDS", (command,))
    return lambda *args: cli.main(["greet", *args])


@pytest.mark.parametrize("args", [[], ["--help"], ["-h"]])
def test_help_names_every_command_and_its_purpose(args, capsys):
    assert cli.main(args) == 0
    text = capsys.readouterr().out
    for command in cli.COMMANDS:
        assert f"  {command.name} " in text
        assert command.help in text
    assert all(len(line) <= 100 for line in text.splitlines())


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"abcd {__version__}\n"


def test_help_is_quick_because_it_imports_nothing_heavy():
    code = (
        "import sys; from abcd_ns.cli import main; main.main(['--help']);"
        "print(sorted({'torch', 'tyro', 'numpy', 'nerfstudio', 'rich'} & set(sys.modules)))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", cli.COMMANDS, ids=lambda command: command.name)
def test_every_command_exists(command):
    module, function = command.target.split(":")
    assert importlib.util.find_spec(module) is not None
    assert callable(command.load()), function


def test_a_missing_package_is_one_line():
    with pytest.raises(UserError, match=r"No module named 'no_such_package'.*`abcd doctor` looks closer"):
        cli.Command("lost", "no_such_package:run", "").load()


def test_arguments_reach_the_function(greet, capsys):
    assert greet("--name", "moon", "--times", "2") == 0
    assert capsys.readouterr().out == "hello moon hello moon\n"


def test_the_function_may_set_the_exit_code(greet):
    assert greet("--name", "three") == 3


def test_help_of_a_command_shows_its_own_name_and_options(greet, capsys):
    with pytest.raises(SystemExit) as stop:
        greet("--help")
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "abcd greet" in text
    assert "whom to greet" in text


def test_wrong_arguments_exit_with_2(greet, capsys):
    with pytest.raises(SystemExit) as stop:
        greet("--nmae", "moon")
    assert stop.value.code == 2
    assert "--nmae" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("snyth", "did you mean 'abcd synth'?"),
        ("xyz", THERE_ARE),
        ("--verbose", THERE_ARE),
    ],
)
def test_an_unknown_command_is_one_line_with_a_hint(name, hint, capsys):
    assert cli.main([name]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == f"error: abcd has no command '{name}'; {hint}\n"


def test_an_error_of_the_user_is_one_line_without_traceback(greet, capsys):
    assert greet("--name", "nobody") == 2
    assert capsys.readouterr().err == "error: nobody: no such scene; give an existing folder.\n"


def test_a_file_that_the_system_refuses_is_one_line(greet, capsys):
    assert greet("--name", "locked") == 2
    assert capsys.readouterr().err == "error: run/log.jsonl cannot be used: Permission denied.\n"


def wrong_words() -> list[tuple[str, str]]:
    """What users type by mistake, in a folder with a run, a photo and nothing else; and what is said."""
    return [
        ("report absent", "absent is no run with abcd/settings.json: there is no such folder"),
        ("report photo.jpg", "photo.jpg is no run"),
        ("report run/abcd", "did you mean"),
        ("report outputs", "outputs is no run with abcd/settings.json: give a folder"),
        ("report run --out absent/page.html", "absent does not exist"),
        ("export absent --out scene.ply", "absent is no run with abcd/store"),
        ("export run --out scene.obj", "run is no run with abcd/store"),
        ("export run --out absent/scene.ply", "absent does not exist; make it first"),
        ("mesh run --data photos --out scene.obj", "--out scene.obj must end in .ply"),
        ("mesh absent --data photos --out scene.ply", "absent is no run"),
        ("plan --data absent", "absent"),
        ("poses absent", "absent/images does not exist"),
        ("train absent.toml", "absent.toml does not exist"),
        ("train run", "run cannot be read as TOML"),
        ("demo --out photo.jpg", "photo.jpg is a file"),
        ("doctor --json absent/doctor.json", "the folder absent does not exist"),
        ("check --data absent --json absent/check.json", "the folder absent does not exist"),
    ]


@pytest.mark.parametrize(("words", "said"), wrong_words(), ids=[words for words, _ in wrong_words()])
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


def test_ctrl_c_is_quiet(greet, capsys):
    assert greet("--name", "ctrl-c") == 130
    assert capsys.readouterr() == ("", "")


def test_a_bug_keeps_its_traceback(greet):
    with pytest.raises(ValueError, match="a bug"):
        greet("--name", "bug")


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_knows_commands_and_options(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["completion", shell])
    assert not ended.value.code
    script = capsys.readouterr().out
    assert "compare" in script
    assert "--max-gaussians" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)
