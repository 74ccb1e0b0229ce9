"""The dashboard in a real browser: sign in, submit, watch, look at texels, act, download."""

import hashlib
import re
import time
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from kiln_schemas.operators import Scope
from kiln_service.config import TokenEntry


def csrf(page):
    return page.locator("input[name=csrf]").first.input_value()


def pixels(page, canvas):
    """What a canvas shows, uint8 [H, W, 4]."""
    width, height, data = page.evaluate(
        """(id) => {
            const canvas = document.getElementById(id);
            const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            return [canvas.width, canvas.height, Array.from(data)];
        }""",
        canvas,
    )
    return np.array(data, np.uint8).reshape(height, width, 4)


def texel_of_map(page, row, column):
    """The colour [4] in the middle of a texel on the light map, 32 texels wide."""
    return page.evaluate(
        """([row, column]) => {
            const canvas = document.getElementById("map"), scale = canvas.width / 32;
            const at = [(column + 0.5) * scale, (row + 0.5) * scale].map(Math.round);
            return Array.from(canvas.getContext("2d").getImageData(...at, 1, 1).data);
        }""",
        [row, column],
    )


def finish_tile(home, worker, bake):
    claim = worker.must_claim("render")
    bake.render(claim["payload"]["tile"])
    worker.finish(claim)


@pytest.fixture
def baked(home, known_bake, tmp_path):
    """A completed job with four tiles of known light fields."""
    job = home.submit(name="baked", gates={"log_mse_rel": 0.5}, labels={"project": "demo"})["id"]
    bake, worker = known_bake(job), home.worker()
    worker.finish(worker.must_claim(), tiles=4, texel_map=bake.texel_map)
    for _ in range(4):
        finish_tile(home, worker, bake)
    claim = worker.must_claim("fit")
    worker.finish(claim, curve=[{"step": step, "loss": 1.0 / step} for step in range(1, 200)], steps=199)
    worker.finish(worker.must_claim("refine"))
    gate = {"name": "log_mse_rel", "value": 0.1739, "threshold": 0.5, "passed": True}
    claim = worker.must_claim("package")
    folder = tmp_path / "package"
    folder.mkdir()
    result = {"kind": "package", "seconds": 1.0, "artifacts": bake.artifacts(folder), "gates": [gate]}
    assert worker.commit(claim, result).status_code == 204
    assert home.job(job)["state"] == "completed"
    return job, bake


def test_sign_in_and_out_with_the_keyboard(dashboard, screenshot, axe):
    page = dashboard.stranger()
    page.goto(f"{dashboard.url}/workers")
    expect(page).to_have_url(re.compile(r"/login\?next=%2Fworkers$"))
    page.keyboard.type("wrong")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("not known here")
    assert axe(page) == []
    screenshot(page, "sign-in")
    page.keyboard.type(dashboard.token)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Workers")).to_be_visible()
    page.get_by_role("button", name="Sign out").press("Enter")
    page.goto(f"{dashboard.url}/jobs")
    expect(page.get_by_label("Access token")).to_be_focused()


def test_a_scene_is_submitted_by_upload(home, dashboard, tmp_path, screenshot, axe):
    scene, sky = b"glTF" + bytes(300_000), b"a sky"
    (tmp_path / "hall.glb").write_bytes(scene)
    (tmp_path / "sky.exr").write_bytes(sky)
    page = dashboard.open("/submit")
    page.set_input_files("#files", tmp_path / "hall.glb")
    page.set_input_files("#environment", tmp_path / "sky.exr")
    expect(page.get_by_label("Name")).to_have_value("hall")
    page.get_by_text("More").click()
    page.get_by_label("Labels").fill("project=demo shot=12")
    page.get_by_label("Settings").fill("render.samples=0")
    assert axe(page) == []
    page.get_by_role("button", name="Upload and submit").click()
    expect(page.get_by_role("status").last).to_contain_text("greater than or equal to 1")
    screenshot(page, "submit")
    page.get_by_label("Settings").fill("render.samples=5")
    page.get_by_role("button", name="Upload and submit").click()
    expect(page.get_by_role("heading", name="hall")).to_be_visible()
    job = home.job(page.url.rpartition("/")[2])
    assert job["bundle"]["files"] == {
        "hall.glb": hashlib.sha256(scene).hexdigest(),
        "sky.exr": hashlib.sha256(sky).hexdigest(),
    }
    assert job["bundle"]["environment"]["file"] == "sky.exr" and job["settings"]["render"]["samples"] == 5
    assert job["labels"] == {"project": "demo", "shot": "12"} and job["submitter"] == "owner"


def test_quality_gates_are_stated_and_what_is_wrong_is_said_at_its_field(home, dashboard, tmp_path, screenshot, axe):
    (tmp_path / "hall.glb").write_bytes(b"glTF")
    page = dashboard.open("/submit")
    uploads = []
    page.on("request", lambda request: uploads.append(request.url) if request.method != "GET" else None)
    submit = page.get_by_role("button", name="Upload and submit")
    submit.click()
    expect(page.locator("#files")).to_have_accessible_description(re.compile("select one or more files"))
    expect(page.locator("#files")).to_be_focused()
    page.set_input_files("#files", tmp_path / "hall.glb")
    page.get_by_text("Quality gates").click()
    page.get_by_label("Light field, at most").fill("2")
    page.get_by_role("button", name="Add a camera").click()
    expect(page.get_by_label("Name").last).to_be_focused()
    page.get_by_label("Name").last.fill("front")
    page.get_by_label("Place, target and angle").fill("3,4,9")
    page.get_by_label("FLIP, at most").fill("0.25")
    page.get_by_text("Quality gates").click()  # folded again: what is wrong unfolds it
    submit.click()
    expect(page.get_by_label("Light field, at most")).to_have_accessible_description(
        re.compile("less than or equal to 1")
    )
    expect(page.get_by_label("Light field, at most")).to_be_focused()
    expect(page.get_by_label("Place, target and angle")).to_have_accessible_description(
        re.compile("px,py,pz:tx,ty,tz:fov")
    )
    expect(page.locator("#submit [aria-invalid]")).to_have_count(2)
    assert uploads == []
    assert axe(page) == []
    screenshot(page, "submit-gates")
    # What only the coordinator knows: zero is no threshold, and a camera has to look somewhere.
    page.get_by_label("Light field, at most").fill("0")
    page.get_by_label("Place, target and angle").fill("3,4,9:0,1,0:45")
    submit.click()
    expect(page.get_by_label("Light field, at most")).to_have_accessible_description(re.compile("greater than 0"))
    expect(page.locator("#submit [aria-invalid]")).to_have_count(1)
    page.get_by_label("Light field, at most").fill("0.3")
    page.get_by_label("Place, target and angle").fill("3,4,9:3,4,9:45")
    submit.click()
    expect(page.get_by_label("Place, target and angle")).to_have_accessible_description(re.compile("position coincide"))
    expect(page.locator("#submit [aria-invalid]")).to_have_count(1)
    page.get_by_label("Place, target and angle").fill("3,4,9:0,1,0:45")
    page.get_by_role("button", name="Add a camera").click()
    for name, value in (("Name", "front"), ("Place, target and angle", "9,4,3:0,1,0:45"), ("FLIP, at most", "0.1")):
        page.get_by_label(name).last.fill(value)
    submit.click()
    expect(page.get_by_label("Name").last).to_have_accessible_description("Another camera has this name.")
    page.get_by_role("button", name="Remove").last.click()
    submit.click()
    expect(page.get_by_role("heading", name="hall")).to_be_visible()
    job = home.job(page.url.rpartition("/")[2])
    assert job["gates"] == {"log_mse_rel": 0.3, "visibility_log_mse_rel": None, "flip": {"front": 0.25}}
    camera = {"position": [3, 4, 9], "target": [0, 1, 0], "fov_deg": 45, "up": [0, 1, 0]}
    assert job["cameras"] == {"front": camera}


def test_progress_comes_by_itself_and_the_reader_keeps_the_place(home, dashboard, known_bake, screenshot):
    job = home.submit(name="live")["id"]
    bake, worker = known_bake(job), home.worker()
    page = dashboard.open(f"/jobs/{job}", viewport={"width": 1280, "height": 500})
    note = page.locator("#atlas-note")
    expect(note).to_contain_text("once the scene is prepared")
    worker.finish(worker.must_claim(), tiles=4, texel_map=bake.texel_map)
    expect(note).to_contain_text("4 tiles: 4 queued")
    page.evaluate("window.opened = true")
    page.get_by_text("Notes (1)").click()
    page.locator("#pick input[name=row]").focus()
    page.keyboard.type("1")
    page.evaluate("window.scrollTo(0, 150)")
    finish_tile(home, worker, bake)
    finish_tile(home, worker, bake)
    expect(note).to_contain_text("2 queued, 2 completed. Irradiance of 2 tiles.")
    expect(page.locator(".stages")).to_contain_text("2 / 4")
    red, green, blue, alpha = texel_of_map(page, 2, 2)
    assert red > green + 20 > blue + 60 and alpha == 255  # the irradiance that was written
    red, green, blue, _ = texel_of_map(page, 2, 20)
    assert blue >= red  # the grey of a queued tile
    assert texel_of_map(page, 2, 7)[3] == 0 and texel_of_map(page, 20, 2)[3] == 0  # gutters
    worker.beat(worker.must_claim("render"))
    expect(note).to_contain_text("1 queued, 1 active, 2 completed")
    expect(page.locator("#tasks")).to_contain_text("active")
    assert page.evaluate("window.opened && document.querySelector('#notes').open && window.scrollY === 150")
    expect(page.locator("#pick input[name=row]")).to_be_focused()
    expect(page.locator("#pick input[name=row]")).to_have_value("1")
    screenshot(page, "job-live")


def test_a_page_whose_scripts_arrive_late_follows_all_the_same(home, dashboard, known_bake):
    job = home.submit(name="late")["id"]
    page = dashboard.open("/jobs")

    def late(route):
        time.sleep(3)  # a slow network, not a wait for something to happen
        route.continue_()

    page.route("**/htmx.min.js", late)
    page.goto(f"{dashboard.url}/jobs/{job}")
    bake, worker = known_bake(job), home.worker()
    worker.finish(worker.must_claim(), tiles=4, texel_map=bake.texel_map)
    expect(page.locator("#atlas-note")).to_contain_text("4 tiles: 4 queued")
    expect(page.locator(".stages")).to_contain_text("0 / 4")


def test_a_tile_that_failed_once_stands_out(home, dashboard, known_bake):
    job = home.submit()["id"]
    bake, worker = known_bake(job), home.worker()
    worker.finish(worker.must_claim(), tiles=4, texel_map=bake.texel_map)
    worker.fail(worker.must_claim("render"))
    page = dashboard.open(f"/jobs/{job}")
    expect(page.locator("#atlas-note")).to_contain_text("4 tiles: 3 queued, 1 soft-failed")
    expect(page.locator(".stages")).to_contain_text("0 +1")
    expect(page.locator("#tasks")).to_contain_text("soft-failed")
    red, green, blue, _ = texel_of_map(page, 2, 2)
    assert red > green > blue  # orange


def test_losses_and_the_log_are_followed_while_a_fit_runs(home, dashboard, known_bake, screenshot, axe):
    job = home.submit()["id"]
    bake, worker = known_bake(job), home.worker()
    worker.finish(worker.must_claim(), tiles=1, texel_map=bake.texel_map)
    finish_tile(home, worker, bake)
    fit = worker.must_claim("fit")
    for step in (10, 20, 30):
        worker.beat(fit, progress={"done": step, "total": 100, "unit": "steps", "loss": 5.0 / step})
    page = dashboard.open(f"/jobs/{job}")
    expect(page.locator("#curves .uplot canvas")).to_be_visible()
    expect(page.locator("#curves")).to_contain_text("active, loss 0.167 after 30 steps")
    worker.beat(fit, log="half of it\n", progress={"done": 50, "total": 100, "unit": "steps", "loss": 0.1})
    expect(page.locator("#curves")).to_contain_text("loss 0.100 after 50 steps")
    page.get_by_role("link", name="fit light_field").click()
    expect(page.get_by_role("log")).to_have_text("--- attempt 1\nhalf of it\n")
    worker.beat(fit, log="more of it\n" * 200)
    expect(page.get_by_role("log")).to_contain_text("more of it")
    end = "log => Math.abs(log.scrollHeight - log.scrollTop - log.clientHeight) < 2"
    assert page.get_by_role("log").evaluate(end)
    assert axe(page) == []
    screenshot(page, "task")


def test_a_clicked_texel_shows_what_was_rendered_and_what_the_lobes_make_of_it(home, dashboard, baked, screenshot, axe):
    job, bake = baked
    page = dashboard.open(f"/jobs/{job}")
    expect(page.locator("#atlas-note")).to_contain_text("Irradiance of 4 tiles")
    box = page.locator("#map").bounding_box()
    row, column = 5, 10
    page.locator("#map").click(
        position={"x": (column + 0.5) * box["width"] / 32, "y": (row + 0.5) * box["height"] / 32}
    )
    expect(page.locator("#texel-facts")).to_contain_text("row 5, column 10")
    rendered = pixels(page, "original")[..., :3].astype(int)
    image = bake.images[row, column].astype(np.float64)
    # The very values: the page's tone curve, undone, is proportional to the image that the store holds.
    linear = np.where(rendered > 10, ((rendered / 255 + 0.055) / 1.055) ** 2.4, rendered / 255 / 12.92)
    radiance = linear / np.maximum(1.0 - linear, 1e-6)
    sure = (rendered > 60) & (rendered < 230)
    scale = radiance[sure] / image[sure]
    assert sure.sum() > 300 and np.abs(scale / np.median(scale) - 1.0).max() < 0.06
    assert (rendered[image.sum(axis=-1) == 0] == 0).all() and (image.sum(axis=-1) == 0).sum() > 200  # the horizon
    # The lobes are those that the image was made of, so the page evaluates the same function as numpy does.
    assert np.abs(pixels(page, "predicted")[..., :3].astype(int) - rendered).max() <= 2
    assert pixels(page, "difference")[..., :3].max() <= 40
    expect(page.locator("#texel-facts")).to_contain_text("0.00, 0.60, 0.80")
    expect(page.locator("#texel-facts")).to_contain_text("8 lobes")
    # By keyboard: the next texel, and the error map.
    page.locator("#map").press("ArrowRight")
    page.locator("#map").press("Enter")
    expect(page.locator("#texel-facts")).to_contain_text("row 5, column 11")
    expect(page.locator("#texel-facts")).to_contain_text("0.0120")  # the error of column 11
    page.get_by_label("error").check()
    dark, bright = texel_of_map(page, 2, 0), texel_of_map(page, 2, 30)
    assert bright[0] + bright[1] > dark[0] + dark[1] + 100
    assert axe(page) == []
    screenshot(page, "job-completed")
    page.get_by_role("link", name=re.compile("0, 8")).click()
    expect(page.get_by_role("heading", name="render tile 0,8")).to_be_visible()
    # The tile is done again: its light and the package are gone until then.
    page.get_by_role("button", name="Do again…").click()
    page.get_by_role("button", name="Do the task again").click()
    expect(page.locator(".head .chip").first).to_have_text("queued")
    page.goto(f"{dashboard.url}/jobs/{job}")
    expect(page.locator("#atlas-note")).to_contain_text("4 tiles: 1 queued, 3 completed. Irradiance of 3 tiles.")
    expect(page.get_by_label("error")).to_be_disabled()
    assert home.events(job)[-2]["detail"]["labels"] == ["tile 0,8"] and home.job(job)["state"] == "queued"


def test_artifacts_are_downloaded_as_they_are_and_a_report_runs_nothing(dashboard, baked, tmp_path: Path):
    job, _ = baked
    page = dashboard.open(f"/jobs/{job}")
    with page.expect_download() as download:
        page.get_by_role("link", name="lightfield.ktx2").click()
    data = Path(download.value.path()).read_bytes()
    assert download.value.suggested_filename == "lightfield.ktx2"
    shown = page.locator("#artifacts tr", has_text="lightfield.ktx2").locator("[title]").get_attribute("title")
    assert hashlib.sha256(data).hexdigest() == shown
    page.get_by_role("link", name="open", exact=True).click()
    page.wait_for_load_state()
    assert page.title() == "report"  # and not what its script would have made of it
    dashboard.faults.clear()  # the browser tells that it ran no script


def test_cancel_asks_first(home, dashboard, screenshot, axe):
    job = home.submit(name="unwanted")["id"]
    page = dashboard.open(f"/jobs/{job}")
    page.get_by_role("button", name="Cancel…").click()
    question = page.get_by_role("dialog", name="Cancel “unwanted”?")
    expect(question).to_be_visible()
    assert axe(page) == []
    screenshot(page, "cancel")
    question.get_by_role("button", name="Leave it").click()
    expect(question).to_be_hidden()
    assert home.job(job)["state"] == "queued"
    page.get_by_role("button", name="Cancel…").press("Enter")
    question.get_by_role("button", name="Cancel the job").press("Enter")
    expect(page.locator(".head .chip")).to_have_text("canceled")
    assert home.job(job)["state"] == "canceled"
    assert home.events(job)[-2]["actor"] == "client:owner"
    page.get_by_role("button", name="Retry…").click()
    page.get_by_role("button", name="Retry the job").click()
    expect(page.locator(".head .chip")).to_have_text("queued")
    page.get_by_role("button", name="Pause…").click()
    page.get_by_role("button", name="Pause the job").click()
    expect(page.locator(".head .chip")).to_have_text("paused")
    page.get_by_role("button", name="Priority…").click()
    page.get_by_label("0 to 100").fill("90")
    page.get_by_role("button", name="Set the priority").click()
    expect(page.locator(".facts").first).to_contain_text("90")
    assert home.job(job)["priority"] == 90


def test_jobs_are_found_and_the_list_stays_fresh(home, dashboard, baked, screenshot, axe):
    home.submit(name="courtyard", labels={"project": "castle"}, priority=80)
    hostile = '<img src=x onerror="document.title=1">'
    archived = home.submit(name=hostile, labels={"a": '"><script>document.title=2</script>'})["id"]
    stopped = home.submit(name="stopped")["id"]
    home.client.post(f"/v1/jobs/{stopped}/cancel").raise_for_status()
    page = dashboard.open(f"/jobs/{archived}")
    expect(page.get_by_role("heading", name=hostile)).to_be_visible()
    assert page.title() == f"{hostile} – lightkiln"
    for action in ("cancel", "archive"):
        home.client.post(f"/v1/jobs/{archived}/{action}").raise_for_status()
    page.goto(f"{dashboard.url}/jobs")
    names = page.locator("#jobs tbody th > a:first-child")
    expect(names).to_have_text(["stopped", "courtyard", "baked"])
    assert axe(page) == []
    screenshot(page, "jobs")
    page.evaluate("window.opened = true")
    search = page.get_by_role("searchbox")
    search.fill("project=castle")
    expect(names).to_have_text(["courtyard"])
    home.submit(name="tower", labels={"project": "castle"})
    expect(names).to_have_text(["tower", "courtyard"])  # by itself, and for the search at hand
    expect(search).to_be_focused()
    assert page.evaluate("window.opened") and page.url.endswith("q=project%3Dcastle")
    page.goto(f"{dashboard.url}/jobs")
    page.get_by_role("link", name="canceled 1").click()
    expect(names).to_have_text(["stopped"])
    page.goto(f"{dashboard.url}/jobs?q=%3Dx")
    expect(page.get_by_role("alert")).to_contain_text("'=x' is not a label")
    page.goto(f"{dashboard.url}/jobs?q=tower")
    home.sql("DELETE FROM sessions")  # an open page leads to the sign-in, and back
    expect(page.get_by_label("Access token")).to_be_visible()
    page.get_by_label("Access token").fill(dashboard.token)
    page.get_by_label("Access token").press("Enter")
    expect(names).to_have_text(["tower"])


def test_workers_are_seen_and_told_and_stuck_tasks_stand_out(home, dashboard, screenshot, axe):
    job = home.submit(name="slow")["id"]
    worker, idle = home.worker("node-1"), home.worker("node-2")
    task = worker.must_claim()["task_id"]
    page = dashboard.open("/workers")
    expect(page.locator(f"#worker-{worker.id}")).to_contain_text("prepare scene")
    expect(page.locator("#stuck")).to_have_count(0)
    home.sql(
        "UPDATE tasks SET heartbeat = now() - interval '6 min', started = now() - interval '9 min' WHERE id = %s", task
    )
    expect(page.locator("#stuck")).to_contain_text("prepare scene")
    expect(page.locator("#stuck")).to_contain_text("6 min")
    home.sql("UPDATE workers SET tags = '{gpu,large}' WHERE id = %s", idle.id)
    home.sql(
        "INSERT INTO blocks SELECT registrant, %s, 'render', now() + interval '1 hour' FROM workers WHERE id = %s",
        job,
        idle.id,
    )
    expect(page.locator(f"#worker-{idle.id}")).to_contain_text("gpu large")
    expect(page.locator(f"#worker-{idle.id}")).to_contain_text("no render of a job until")
    assert axe(page) == []
    screenshot(page, "workers")
    page.get_by_role("button", name="Unblock node-2").click()
    page.get_by_role("button", name="Unblock the worker").click()
    expect(page.locator(f"#worker-{idle.id}")).not_to_contain_text("no render of")
    page.get_by_role("button", name="Sleep node-2").click()
    page.get_by_role("button", name="Sleep the worker").click()
    expect(page.locator(f"#worker-{idle.id}")).to_contain_text("asleep")
    page.get_by_role("button", name="Wake node-2").click()
    page.get_by_role("button", name="Wake the worker").click()
    expect(page.locator(f"#worker-{idle.id}")).to_contain_text("awake")
    done = [entry["action"] for entry in home.client.get("/v1/audit").json()]
    assert done[:3] == ["worker.wake", "worker.sleep", "worker.unblocked"]
    assert home.job(job)["state"] == "active"


def test_who_may_only_read_sees_no_buttons_and_is_told_why_not(start, browser):
    from .conftest import Dashboard

    entry = TokenEntry(name="looker", sha256=hashlib.sha256(b"look").hexdigest(), scopes=(Scope.READ,))
    with start(tokens=(entry,)) as home:
        dashboard = Dashboard(browser, home.url, "look", [], [])
        job = home.submit()["id"]
        home.worker("node-1")
        page = dashboard.open(f"/jobs/{job}")
        expect(page.get_by_role("heading", name="test")).to_be_visible()
        expect(page.get_by_role("button", name=re.compile("…$"))).to_have_count(0)
        token = csrf(page)
        page.evaluate(
            """([path, csrf]) => {
                const form = Object.assign(document.createElement("form"), { method: "post", action: path });
                form.append(Object.assign(document.createElement("input"), { name: "csrf", value: csrf }));
                document.body.append(form);
                form.submit();
            }""",
            [f"/jobs/{job}/do/cancel", token],
        )
        expect(page.get_by_role("alert")).to_contain_text("The token 'looker' has no scope 'submit'")
        assert home.job(job)["state"] == "queued"
        page.goto(f"{dashboard.url}/workers")
        expect(page.get_by_text("node-1")).to_be_visible()
        expect(page.get_by_role("button", name=re.compile("…$"))).to_have_count(0)
        page.goto(f"{dashboard.url}/submit")
        expect(page.get_by_role("alert")).to_contain_text("has no scope 'submit'")
        page.context.close()
        assert dashboard.faults == []


def test_without_scripts_people_still_see_and_act(home, dashboard, baked):
    job = home.submit(name="plain")["id"]
    page = dashboard.open("/jobs?q=plain", java_script_enabled=False)
    page.get_by_role("link", name="plain").click()
    page.get_by_role("button", name="Cancel…").click()
    page.get_by_role("button", name="Cancel the job").click()
    expect(page.locator(".head .chip")).to_have_text("canceled")
    assert home.job(job)["state"] == "canceled"
    page.goto(f"{dashboard.url}/jobs/{baked[0]}")
    expect(page.locator("#artifacts")).to_contain_text("lightfield.ktx2")
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Access token")).to_be_visible()
