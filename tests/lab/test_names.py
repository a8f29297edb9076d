"""Scenes, folders and options may be called anything: no table and no chart breaks."""

from io import StringIO

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.results.results import Arm
from abcd_ns.lab.results.tables import markdown, print_rows
from tests.lab.compare.records import made_up, made_up_run, made_up_settings

NAMES = st.text("ab |$\\\n\r[]/_^{}#%&<>`*:=", min_size=1, max_size=12)
MARKDOWN = MarkdownIt("commonmark").enable("table")


@example(["a|b", "\\|", "\\\\||\\", "a\nb", "$x$|$y$", "`|`"])
@given(st.lists(NAMES, min_size=2, max_size=6))
def test_a_row_has_a_cell_for_each_column_whatever_they_are_called(names):
    text = markdown([names, names])
    tokens = [token.type for token in MARKDOWN.parse(text)]
    assert (tokens.count("th_open"), tokens.count("td_open")) == (len(names), len(names))
    assert len(text.splitlines()) == 3


@example(["[/]", "[red]", "a\\"])
@given(st.lists(NAMES.filter(str.isprintable), min_size=1, max_size=3))
def test_a_table_in_the_terminal_shows_names_as_they_are(names):
    stream = StringIO()
    print_rows([["", "x"], *([name, "1"] for name in names)], names, Console(file=stream, width=200))
    assert all(name.rstrip() in stream.getvalue() for name in names)


@pytest.mark.parametrize("name", ["a$\\frac{$", "a|b"])
def test_a_chart_says_names_as_they_are_and_no_formulae(name, tmp_path, drawn):
    arms = [Arm("abcd", variant, None, (made_up_run(),)) for variant in ("default", f"training.x={name}")]
    draw_charts(made_up("comparison", *arms, settings=made_up_settings(data=name)), tmp_path)
    texts = drawn["speed_accuracy.png"]
    assert any(text.startswith(f"{name}, 1/4 size") for text in texts)
    assert any(text.startswith(f"x={name}") for text in texts)
