"""The `abcd` command: what it prints, what it returns, and what it does not import."""

import importlib.util
import shutil
import subprocess
import sys
from types import ModuleType

import pytest

from abcd_ns import __version__
from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError

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


@pytest.mark.parametrize(("no_color", "expected"), [(False, "\033[31merror\033[0m\n"), (True, "error\n")])
def test_errors_are_red_on_a_terminal_unless_asked_not_to(no_color, expected, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.delenv("NO_COLOR", raising=False)
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    cli.print_error("error")
    assert capsys.readouterr().err == expected


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
