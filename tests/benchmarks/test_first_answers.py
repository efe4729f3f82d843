"""Processor time of the first call in a new process, relative to a fixed JAX program."""

import pytest

import vijax
from benchmarks import first_answers as tool

# Multiples of the processor time of the fixed program: slightly more than 1.5 times the values of an idle machine.
MAX_RATIO = {"trajectory": 1.8, "sweep": 5.5}


@pytest.fixture(scope="module")
def peer(tmp_path_factory):
    return tool.answer(tool.PEER, tmp_path_factory.mktemp("peer")).processor


@pytest.mark.long
@pytest.mark.parametrize("question", MAX_RATIO)
def test_first_call_is_within_its_time_limit(peer, tmp_path, question):
    assert tool.answer(tool.program(question), tmp_path).processor < MAX_RATIO[question] * peer


def test_all_public_functions_occur_in_a_question():
    """Exceptions are functions that wait for a browser or a disk."""
    functions = {name for name in dir(vijax) if name.islower()} - {"explore", "load", "plots", "save"}
    programs = " ".join(tool.QUESTIONS.values())
    assert {
        name for name in functions if f"vijax.{name}(" not in programs and f"vijax.{name}\n" not in programs
    } == set()


def test_question_without_an_answer_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match=r"(?s)must have an answer.*ZeroDivisionError"):
        tool.answer("1 / 0", tmp_path)
