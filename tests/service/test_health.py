"""Whether a coordinator can work is asked by anybody, and found out once a second."""

from concurrent.futures import ThreadPoolExecutor

import httpx


def test_many_who_ask_cost_one_probe(home, monkeypatch):
    monkeypatch.setattr("kiln_service.api.health.FRESH_S", 3600.0)
    blobs, probes = home.app.state.parts.blobs, []

    async def check():
        probes.append(1)
        await type(blobs).check(blobs)

    monkeypatch.setattr(blobs, "check", check)
    with ThreadPoolExecutor(8) as threads:
        statuses = list(threads.map(lambda _: httpx.get(f"{home.url}/readyz").status_code, range(40)))
    assert statuses == [200] * 40 and len(probes) == 1


def test_an_answer_grows_old(home, monkeypatch, eventually):
    monkeypatch.setattr("kiln_service.api.health.FRESH_S", 0.05)
    assert httpx.get(f"{home.url}/readyz").status_code == 200
    home.sql("ALTER TABLE kiln_migrations RENAME TO hidden")
    eventually(lambda: httpx.get(f"{home.url}/readyz").status_code == 500)
    home.sql("ALTER TABLE hidden RENAME TO kiln_migrations")
    eventually(lambda: httpx.get(f"{home.url}/readyz").status_code == 200)
