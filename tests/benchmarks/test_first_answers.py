"""The first answer of a new process stays quick: what compiles is watched against a fixed program of JAX."""

import pytest

import vijax
from benchmarks import first_answers as tool

# Multiples of the peer's processor time, half again what was measured on a quiet machine and somewhat more.
MOST = {"trajectory": 1.8, "sweep": 5.5}


@pytest.fixture(scope="module")
def peer(tmp_path_factory):
    return tool.answer(tool.PEER, tmp_path_factory.mktemp("peer")).processor


@pytest.mark.long
@pytest.mark.parametrize("question", MOST)
def test_a_first_answer_takes_no_longer_than_it_did(peer, tmp_path, question):
    assert tool.answer(tool.program(question), tmp_path).processor < MOST[question] * peer


def test_every_function_that_is_offered_is_asked():
    """But for what waits for a browser, or for a disk."""
    functions = {name for name in dir(vijax) if name.islower()} - {"explore", "load", "plots", "save"}
    asked = " ".join(tool.QUESTIONS.values())
    assert {name for name in functions if f"vijax.{name}(" not in asked and f"vijax.{name}\n" not in asked} == set()


def test_a_question_without_an_answer_is_told(tmp_path):
    with pytest.raises(RuntimeError, match=r"(?s)must have an answer.*ZeroDivisionError"):
        tool.answer("1 / 0", tmp_path)
