"""One job per kind: the newest job replaces an older job, and a cancelled job delivers nothing."""

import threading

import pytest

from vijax.explorer.server.jobs import Jobs, JobThreads


@pytest.fixture
def jobs():
    """Jobs with immediate deliveries in the thread of the job."""
    threads = JobThreads()
    yield Jobs(threads, lambda then: then())
    threads.close()


def finished(job) -> None:
    """Wait until the thread of a job has finished it."""
    if job.future is not None and not job.future.cancelled():
        job.future.result(timeout=10)


def test_job_delivers_its_progress_and_result(jobs):
    deliveries = []
    job = jobs.start(
        "one",
        lambda report: report(1, 2) or 7,
        deliveries.append,
        deliveries.append,
        lambda *step: deliveries.append(step),
    )
    finished(job)
    assert deliveries == [(1, 2), 7]
    assert jobs.running() == ()


def test_error_of_a_job_is_delivered_as_a_line(jobs):
    deliveries = []

    def fail(report):
        raise ValueError("first\nsecond")

    finished(jobs.start("one", fail, deliveries.append, lambda text: deliveries.append(text.upper())))
    assert deliveries == ["FIRST SECOND"]


def test_newest_job_replaces_older_jobs_at_their_next_report(jobs):
    started, go, deliveries, steps = threading.Event(), threading.Event(), [], []

    def slow(report):
        started.set()
        go.wait(10)
        for step in range(5):
            steps.append(step)
            report(step, 5)
        return "old"

    old = jobs.start("one", slow, deliveries.append, deliveries.append)
    assert started.wait(10)
    waiting = jobs.start("one", lambda report: "between", deliveries.append, deliveries.append)
    new = jobs.start("one", lambda report: "new", deliveries.append, deliveries.append)
    go.set()
    for job in (old, waiting, new):
        finished(job)
    assert deliveries == ["new"]
    assert steps == [0]


@pytest.mark.parametrize("succeeds", [True, False])
def test_cancelled_job_without_progress_delivers_nothing(jobs, succeeds):
    started, go, deliveries = threading.Event(), threading.Event(), []

    def silent(report):
        started.set()
        assert go.wait(10)
        return "old" if succeeds else 1 / 0

    old = jobs.start("one", silent, deliveries.append, deliveries.append)
    assert started.wait(10)
    new = jobs.start("one", lambda report: "new", deliveries.append, deliveries.append)
    go.set()
    for job in (old, new):
        finished(job)
    assert deliveries == ["new"]


def test_jobs_of_two_pages_do_not_cancel_the_jobs_of_the_other_page():
    threads, go, deliveries = JobThreads(), threading.Event(), {"one": [], "other": []}
    pages = {name: Jobs(threads, lambda then: then()) for name in deliveries}
    work = {"one": lambda report: (go.wait(10) and report(0, 1)) or 1, "other": lambda report: 2}
    jobs = [
        pages[name].start("motion", work[name], deliveries[name].append, deliveries[name].append) for name in deliveries
    ]
    go.set()
    for job in jobs:
        finished(job)
    assert deliveries == {"one": [1], "other": [2]}
    threads.close()


def test_kinds_run_in_parallel_and_end_with_their_page(jobs):
    go, deliveries = threading.Event(), []
    slow = jobs.start("slow", lambda report: go.wait(10) and report(0, 1), deliveries.append, deliveries.append)
    finished(jobs.start("quick", lambda report: "quick", deliveries.append, deliveries.append))
    assert deliveries == ["quick"]
    assert jobs.running() == ("slow",)
    jobs.close()
    go.set()
    finished(slow)
    assert deliveries == ["quick"]
    assert not jobs.cancel("slow")
