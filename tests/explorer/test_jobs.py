"""One job a kind, the newest wins; what is cancelled tells nobody anything."""

import threading

import pytest

from vijax.explorer.jobs import Crew, Jobs


@pytest.fixture
def jobs():
    """Jobs whose deliveries come at once, in the thread of the job."""
    crew = Crew()
    yield Jobs(crew, lambda then: then())
    crew.close()


def finished(job) -> None:
    """Wait until a job's thread is done with it."""
    if job.future is not None and not job.future.cancelled():
        job.future.result(timeout=10)


def test_a_job_tells_what_it_found_and_how_far_it_is(jobs):
    heard = []
    job = jobs.start("one", lambda tell: tell(1, 2) or 7, heard.append, heard.append, lambda *step: heard.append(step))
    finished(job)
    assert heard == [(1, 2), 7]
    assert jobs.running() == ()


def test_what_a_job_raises_is_told_in_one_line(jobs):
    said = []

    def fail(tell):
        raise ValueError("first\nsecond")

    finished(jobs.start("one", fail, said.append, lambda text: said.append(text.upper())))
    assert said == ["FIRST SECOND"]


def test_the_newest_wins_and_the_older_ends_at_its_next_word(jobs):
    begun, go, heard, steps = threading.Event(), threading.Event(), [], []

    def slow(tell):
        begun.set()
        go.wait(10)
        for step in range(5):
            steps.append(step)
            tell(step, 5)
        return "old"

    old = jobs.start("one", slow, heard.append, heard.append)
    assert begun.wait(10)
    waiting = jobs.start("one", lambda tell: "between", heard.append, heard.append)
    new = jobs.start("one", lambda tell: "new", heard.append, heard.append)
    go.set()
    for job in (old, waiting, new):
        finished(job)
    assert heard == ["new"]
    assert steps == [0]


@pytest.mark.parametrize("succeeds", [True, False])
def test_what_is_cancelled_and_tells_no_progress_delivers_nothing(jobs, succeeds):
    begun, go, heard = threading.Event(), threading.Event(), []

    def silent(tell):
        begun.set()
        assert go.wait(10)
        return "old" if succeeds else 1 / 0

    old = jobs.start("one", silent, heard.append, heard.append)
    assert begun.wait(10)
    new = jobs.start("one", lambda tell: "new", heard.append, heard.append)
    go.set()
    for job in (old, new):
        finished(job)
    assert heard == ["new"]


def test_two_pages_wait_for_each_other_and_cancel_nothing_of_each_other():
    crew, go, heard = Crew(), threading.Event(), {"one": [], "other": []}
    pages = {name: Jobs(crew, lambda then: then()) for name in heard}
    work = {"one": lambda tell: (go.wait(10) and tell(0, 1)) or 1, "other": lambda tell: 2}
    jobs = [pages[name].start("motion", work[name], heard[name].append, heard[name].append) for name in heard]
    go.set()
    for job in jobs:
        finished(job)
    assert heard == {"one": [1], "other": [2]}
    crew.close()


def test_kinds_do_not_wait_for_each_other_and_all_end_with_their_page(jobs):
    go, heard = threading.Event(), []
    slow = jobs.start("slow", lambda tell: go.wait(10) and tell(0, 1), heard.append, heard.append)
    finished(jobs.start("quick", lambda tell: "quick", heard.append, heard.append))
    assert heard == ["quick"]
    assert jobs.running() == ("slow",)
    jobs.close()
    go.set()
    finished(slow)
    assert heard == ["quick"]
    assert not jobs.cancel("slow")
