"""Claims and commits of one job that are answered together."""

import asyncio
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest

from kiln_schemas.errors import InputError
from kiln_service.batches import MOST, Batches
from kiln_service.db import Database


def run(home, serve, *questions):
    """Ask all at once of one job; the answers or exceptions, and how many questions each transaction was given."""
    sizes = []

    async def counted(tx, job_id, given):
        sizes.append(len(given))
        return await serve(tx, job_id, given)

    async def ask():
        async with Database(home.config.database) as database:
            batches = Batches(database, counted)
            return await asyncio.gather(*(batches.ask("job", one) for one in questions), return_exceptions=True)

    return asyncio.run(ask()), sizes


async def doubled(tx, job_id, given):
    await tx.one("ping")
    return [2 * one for one in given]


def test_what_is_asked_meanwhile_is_answered_together_and_each_gets_its_own(shared):
    answers, sizes = run(shared, doubled, *range(2 * MOST + 5))
    assert answers == [2 * one for one in range(2 * MOST + 5)]
    assert max(sizes) <= MOST and sum(sizes) == len(answers) and len(sizes) <= 4


def test_an_error_that_is_an_answer_is_nobody_elses(shared):
    async def serve(tx, job_id, given):
        return [InputError("odd", where="here") if one % 2 else one for one in given]

    answers, _ = run(shared, serve, 0, 1, 2)
    assert answers[0::2] == [0, 2] and isinstance(answers[1], InputError)


def test_a_batch_that_fails_is_done_again_one_by_one(home):
    """What the others of the batch wrote before is rolled back with it and written once in the end."""

    async def serve(tx, job_id, given):
        for one in given:
            await tx.run("add_audit", actor="test", action=str(one), target="t", detail=None if one == 3 else "{}")
        return list(given)

    answers, sizes = run(home, serve, *range(6))
    assert [one for one in answers if not isinstance(one, Exception)] == [0, 1, 2, 4, 5]
    assert "null value" in str(answers[3]) and sizes.count(1) >= 5
    written = [row["action"] for row in home.sql("SELECT action FROM audit WHERE actor = 'test'")]
    assert sorted(written) == ["0", "1", "2", "4", "5"]


def test_a_question_that_nobody_waits_for_any_more_is_not_served(shared):
    served = []

    async def ask():
        go = asyncio.Event()

        async def serve(tx, job_id, given):
            served.extend(given)
            await go.wait()
            return list(given)

        async with Database(shared.config.database) as database:
            batches = Batches(database, serve)
            first = asyncio.create_task(batches.ask("job", 1))
            while not served:
                await asyncio.sleep(0.01)
            gone, last = asyncio.create_task(batches.ask("job", 2)), asyncio.create_task(batches.ask("job", 3))
            await asyncio.sleep(0.01)
            gone.cancel()
            go.set()
            with pytest.raises(asyncio.CancelledError):
                await gone
            return await first, await last

    assert asyncio.run(ask()) == (1, 3)
    assert served == [1, 3]


def test_workers_that_ask_at_once_get_different_tasks_and_the_last_commit_ends_the_stage(home, result):
    job, first = home.submit(), home.worker()
    first.finish(first.must_claim("prepare"), tiles=16)
    workers = [home.worker(f"w{number}") for number in range(16)]
    with ThreadPoolExecutor(16) as threads:
        claims = list(threads.map(lambda worker: worker.must_claim("render", wait_s=20), workers))
        assert len({claim["task_id"] for claim in claims}) == 16
        sent = [*claims[:8], claims[5] | {"attempt": 7}, *claims]  # the first eight twice, as where answers were lost
        results = [result(home, claim) for claim in sent]
        replies = list(threads.map(first.commit, sent, results))
    assert [reply.status_code for reply in replies] == [204] * 8 + [409] + [204] * 16
    events = Counter(event["kind"] for event in home.events(job["id"]))
    assert events["task.completed"] == 17 and events["tasks.queued"] == 1, "the fits were released once"
