"""Sign-in, sessions, CSRF, scopes and headers of the dashboard, as a browser sees them but without one."""

import hashlib
import re
from contextlib import contextmanager

import httpx
import pytest
from fastapi.routing import APIRoute

from kiln_schemas.operators import Scope
from kiln_service.config import TokenEntry
from kiln_service.problems import is_open

HTML = {"Accept": "text/html"}


@contextmanager
def browser(home, token):
    """A client with a browser's headers, signed in."""
    with httpx.Client(base_url=home.url, headers=HTML) as client:
        reply = client.post("/login", data={"token": token})
        assert reply.status_code == 303, reply.text
        yield client


def csrf(client):
    return re.search(r'name="csrf" value="(\w+)"', client.get("/jobs").text)[1]


def pages(home):
    """Method and path, with something for its parameters, of every route that OpenAPI does not list."""
    routers = [getattr(route, "original_router", None) for route in home.app.routes]
    routes = [*home.app.routes, *(route for router in routers if router for route in router.routes)]
    for route in routes:
        if isinstance(route, APIRoute) and not route.include_in_schema:
            for method in sorted(route.methods - {"HEAD"}):
                yield method, re.sub(r"{\w+(:\w+)?}", "1", route.path)


@pytest.fixture
def reader(start):
    """A coordinator that knows a token `look` for reading alone."""
    entry = TokenEntry(name="looker", sha256=hashlib.sha256(b"look").hexdigest(), scopes=(Scope.READ,))
    with start(tokens=(entry,)) as home:
        yield home


def test_every_page_asks_strangers_to_sign_in(shared):
    found = [(method, path) for method, path in pages(shared) if not is_open(path)]
    assert len(found) >= 3
    with httpx.Client(base_url=shared.url, cookies={"kiln_session": "guessed"}) as stranger:
        for method, path in found:
            reply = stranger.request(method, path, headers=HTML)
            assert reply.status_code == 303 and reply.headers["location"].startswith("/login"), (method, path)
            reply = stranger.request(method, path)
            assert reply.status_code == 401 and reply.json()["code"] == "unauthorized", (method, path)
        assert stranger.get("/static/../jobs", headers=HTML).status_code in (303, 404)
        assert stranger.get("/static/%2e%2e/pages.py").status_code == 404


def test_no_page_acts_without_the_csrf_token_of_its_session(shared):
    acting = [(method, path) for method, path in pages(shared) if method != "GET" and path != "/login"]
    assert acting
    with browser(shared, shared.token) as mine, browser(shared, shared.token) as other:
        for method, path in acting:
            for form in ({}, {"csrf": "0" * 64}, {"csrf": csrf(other)}):
                reply = mine.request(method, path, data=form, headers={"X-CSRF-Token": form.get("csrf", "")})
                assert reply.status_code == 403, (method, path)
                assert "does not belong to this session" in reply.text


@pytest.mark.parametrize(
    "headers", [{"Origin": "https://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}]
)
def test_another_site_acts_for_nobody(shared, headers):
    with browser(shared, shared.token) as mine:
        assert mine.post("/logout", data={"csrf": csrf(mine)}, headers=headers).status_code == 403
        assert mine.post("/login", data={"token": shared.token}, headers=headers).status_code == 403
        assert mine.get("/jobs").status_code == 200


def test_the_cookie_is_for_the_browser_alone_and_is_not_the_token(shared):
    with httpx.Client(base_url=shared.url, headers=HTML) as client:
        reply = client.post("/login", data={"token": f" {shared.token}\n", "next": "/workers"})
    assert reply.status_code == 303 and reply.headers["location"] == "/workers"
    cookie = reply.headers["set-cookie"]
    assert "HttpOnly" in cookie and "samesite=strict" in cookie.lower()
    value = re.match(r"kiln_session=([\w-]{43});", cookie)[1]
    kept = shared.sql("SELECT * FROM sessions")
    assert shared.token not in cookie and hashlib.sha256(value.encode()).hexdigest() in {row["sha256"] for row in kept}
    assert value not in str(kept) and shared.token not in str(kept)


def test_a_wrong_token_is_told_on_the_form(shared):
    with httpx.Client(base_url=shared.url, headers=HTML) as client:
        reply = client.post("/login", data={"token": "wrong"})
    assert reply.status_code == 401 and "not known here" in reply.text and "set-cookie" not in reply.headers


@pytest.mark.parametrize("target", ["//evil.example", "https://evil.example", "/\\evil.example", "/login", "\x00"])
def test_sign_in_leads_to_no_other_site(shared, target):
    with httpx.Client(base_url=shared.url, headers=HTML) as client:
        reply = client.post("/login", data={"token": shared.token, "next": target})
    assert reply.headers["location"] == "/jobs"


def test_a_cookie_reads_the_interface_but_changes_nothing_there(shared):
    job = shared.submit()["id"]
    with browser(shared, shared.token) as mine:
        assert mine.get(f"/v1/jobs/{job}").json()["id"] == job
        assert mine.post(f"/v1/jobs/{job}/cancel").status_code == 401
        assert mine.post("/v1/tokens", json={"name": "mine", "scopes": ["admin"]}).status_code == 401
    assert shared.job(job)["state"] == "queued"


def test_signing_out_ends_the_session_everywhere(shared):
    with browser(shared, shared.token) as mine:
        cookies = dict(mine.cookies)
        assert mine.post("/logout", data={"csrf": csrf(mine)}).headers["location"] == "/login"
    with httpx.Client(base_url=shared.url, cookies=cookies, headers=HTML) as again:
        assert again.get("/jobs").status_code == 303


def test_a_session_ends_with_its_token_and_its_time(home):
    made = home.client.post("/v1/tokens", json={"name": "guest", "scopes": ["read"]}).json()
    with browser(home, home.token) as owner, browser(home, made["token"]) as guest:
        assert guest.get("/jobs").status_code == 200
        home.client.delete("/v1/tokens/guest").raise_for_status()
        home.app.state.parts.tokens._remembered.clear()  # what is remembered for two seconds
        assert guest.get("/jobs").status_code == 303
        home.sql("UPDATE sessions SET expires = now()")
        assert owner.get("/jobs").status_code == 303
        with browser(home, home.token):
            pass
        assert len(home.sql("SELECT * FROM sessions")) == 1


def test_two_coordinators_know_the_same_sessions(start):
    with start() as one, start() as two:
        with browser(one, one.token) as mine:
            cookies = dict(mine.cookies)
        with httpx.Client(base_url=two.url, cookies=cookies, headers=HTML) as there:
            assert there.get("/jobs").status_code == 200


def test_pages_may_run_and_load_their_own_files_alone(shared):
    with browser(shared, shared.token) as mine:
        for path in ("/jobs", "/login", "/static/dashboard.css", "/static/vendor/htmx/htmx.min.js"):
            policy = mine.get(path).raise_for_status().headers["content-security-policy"]
            assert "default-src 'none'" in policy and "script-src 'self';" in policy and "unsafe" not in policy
        script = mine.get("/static/refresh.js")
        assert script.headers["cache-control"] == "no-cache"
        again = mine.get("/static/refresh.js", headers={"If-None-Match": script.headers["etag"]})
        assert again.status_code == 304 and not again.content
        headers = mine.get("/v1/jobs").headers
        assert headers["content-security-policy"].startswith("sandbox;")
        assert headers["x-content-type-options"] == "nosniff"
        text = mine.get("/jobs").text
        assert "style=" not in text and not re.search(r"<script(?! src)", text) and not re.search(r'"https?://', text)


def test_vendored_files_are_those_that_are_named():
    import importlib.resources

    folder = importlib.resources.files("kiln_service.dashboard") / "vendor"
    named = dict(
        re.findall(r"^\| `([\w./-]+)` \|.*\| `([0-9a-f]{64})` \|$", (folder / "VENDORED.md").read_text(), re.M)
    )
    there = {
        f"{package.name}/{file.name}": hashlib.sha256(file.read_bytes()).hexdigest()
        for package in folder.iterdir()
        if package.is_dir()
        for file in package.iterdir()
    }
    assert named == there and there
