"""Scenes, folders and options may be called anything: no table and no chart breaks."""

import dataclasses
from io import StringIO

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

from abcd_ns.lab.compare.charts import draw_speed_accuracy
from abcd_ns.lab.results.tables import markdown, print_rows
from abcd_ns.lab.study.charts import draw_study
from tests.lab.compare.records import made_up_results, made_up_run, made_up_settings
from tests.lab.study.records import made_up_arm, options_study
from tests.lab.svg import texts_of

NAMES = st.text("ab |$\\\n\r[]/_^{}#%&<>`*:=", min_size=1, max_size=12)
MARKDOWN = MarkdownIt("commonmark").enable("table")


@example(["a|b", "\\|", "\\\\||\\", "a\nb", "$x$|$y$", "`|`"])
@given(st.lists(NAMES, min_size=2, max_size=6))
def test_a_row_has_a_cell_for_each_column_whatever_they_are_called(names):
    text = markdown([names, names])
    tokens = [token.type for token in MARKDOWN.parse(text)]
    assert (tokens.count("th_open"), tokens.count("td_open")) == (len(names), len(names))
    assert len(text.splitlines()) == 3


def test_bars_and_dollars_stand_in_a_cell_as_they_are():
    (cells,) = (token.content for token in MARKDOWN.parse(markdown([["", "x"], ["a|b", "$|$"]]))[-5:-4])
    assert cells == "$|$"


@example(["[/]", "[red]", "a\\"])
@given(st.lists(NAMES.filter(str.isprintable), min_size=1, max_size=3))
def test_a_table_in_the_terminal_shows_names_as_they_are(names):
    stream = StringIO()
    print_rows([["", "x"], *([name, "1"] for name in names)], names, Console(file=stream, width=200))
    assert all(name.rstrip() in stream.getvalue() for name in names)


@pytest.mark.parametrize("scene", ["$a$", "a$\\frac{$", "x_$^_$", "a|b", "<&>"])
def test_a_charts_title_is_the_scenes_name_and_no_formula(tmp_path, scene):
    results = made_up_results(made_up_run(), settings=made_up_settings(data=scene))
    draw_speed_accuracy(results, tmp_path)
    assert any(text.startswith(f"{scene}, 1/4 size") for text in texts_of(tmp_path / "speed_accuracy.svg"))


def test_a_studys_changes_are_no_formulae(tmp_path):
    base, name = options_study(), "training.x=$\\frac{$|"
    arms = (base.arms[0], made_up_arm(name, None, {0: 23.0}))
    (picture,) = (p for p in draw_study(dataclasses.replace(base, arms=arms), tmp_path) if p.suffix == ".svg")
    assert any(name in text for text in texts_of(picture))
