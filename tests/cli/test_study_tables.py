"""`roadproof study tables`, called as people call it."""

import functools

import pytest

from made_up_study import METHODS, made_up_study, write_made_up_study
from roadproof.study.folder import write_result, write_table
from roadproof.study.rows import failed


@pytest.fixture
def tables(invoke):
    return functools.partial(invoke, "study", "tables")


def small():
    return made_up_study(scenarios=made_up_study().scenarios[:1], figures=(1,), methods=METHODS[:1], traffic=None)


def test_tables_are_written_where_asked(tables, tmp_path):
    write_made_up_study(tmp_path / "study", small())
    code, ran = tables(tmp_path / "study", "--out", tmp_path / "shown")
    assert (code, ran.err) == (0, "")
    assert ran.out.count("\n") == 1
    assert f"The tables are {tmp_path / 'shown' / 'tables.html'}" in ran.out
    assert (tmp_path / "shown" / "methods.tex").exists()


def test_a_study_without_results_is_one_line(tables, tmp_path):
    code, ran = tables(tmp_path)
    assert (code, ran.out) == (2, "")
    assert ran.err == f"roadproof: {tmp_path} has no rows.parquet; run the study first\n"


def test_a_study_in_which_all_failed_is_one_line(tables, tmp_path):
    study = small()
    for job in study.jobs:
        write_result(job, failed(job, "no luck"), tmp_path)
    write_table(study.jobs, tmp_path)
    code, ran = tables(tmp_path)
    assert code == 2
    assert ran.err.startswith("roadproof: no job came to its end; the first of 1 that failed (")
    assert ran.err.count("\n") == 1
    assert not (tmp_path / "tables").exists()
