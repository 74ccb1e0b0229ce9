"""Names, labels, keys and numbers that no contract takes: exit code 2 or 3, and a sentence that names the option."""

import pytest

NAMES = ["a\nb", "a\tb", "x" * 300, "a\x1bb", "\u202egnp"]
SUBMIT = [
    *(("--name", name) for name in NAMES),
    *(("--label", f"k={name}") for name in NAMES),
    *(("--tag", name) for name in ("a b", "a\nb", "x" * 64)),
    *(("--idempotency-key", key) for key in ("schlüssel", "a\nb", "x" * 256, " a", "")),
    ("--set", "render.samples=" + "9" * 300),  # the sentence names the setting
    ("--env-scale", "nan"),
]
NOT_UTF8 = "a\udcff"


def check(done, option):
    assert done.code in (2, 3), done
    names = {"--set": "render.samples", "--preset": "preset"}
    assert names.get(option, option) in done.err and "defect" not in done.err + done.out, done


@pytest.mark.parametrize(("option", "value"), SUBMIT)
def test_submit_names_the_option(lightkiln, coordinator, lit_glb, option, value):
    more = ("--env", lit_glb) if option == "--env-scale" else ()
    flags = ("--url", coordinator.url, "--token", coordinator.farm.token)
    check(lightkiln("submit", lit_glb, *flags, *more, option, value), option)


@pytest.mark.parametrize("option", ["--name", "--label", "--tag", "--idempotency-key", "--preset"])
def test_what_is_not_utf8_is_refused_too(lightkiln, coordinator, lit_glb, option):
    value = f"k={NOT_UTF8}" if option == "--label" else NOT_UTF8
    flags = ("--url", coordinator.url, "--token", coordinator.farm.token)
    check(lightkiln("submit", lit_glb, *flags, option, value), option)


def test_a_scene_with_an_odd_name_asks_for_another(lightkiln, coordinator, lit_glb):
    odd = lit_glb.rename(lit_glb.with_name("a\nb.glb"))
    done = lightkiln("submit", odd, "--url", coordinator.url, "--token", coordinator.farm.token)
    assert done.code == 3 and "control character" in done.err


@pytest.mark.parametrize("name", ["a\nb", "a\tb", "x" * 129, "", NOT_UTF8])
def test_worker_names_the_option(lightkiln, coordinator, tmp_path, name):
    flags = ("--url", coordinator.url, "--token", coordinator.farm.token, "--scratch", tmp_path)
    done = lightkiln("worker", *flags, "--name", name)
    check(done, "--name")


@pytest.mark.parametrize(("option", "value"), [("--memory", "9" * 400 + "GiB"), ("--threads", "99999999999")])
def test_a_worker_of_any_size_is_refused(lightkiln, coordinator, tmp_path, option, value):
    flags = ("--url", coordinator.url, "--token", coordinator.farm.token, "--scratch", tmp_path)
    check(lightkiln("worker", *flags, option, value), option)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("status", "--name", "x" * 129), "--name"),
        (("status", "--label", "k=a\nb"), "--label"),
        (("status", NOT_UTF8), "JOB"),
        (("change", "job", "--label", "k=a\nb"), "--label"),
        (("requeue", "job", "--task", "x" * 65), "--task"),
        (("requeue", "job", "--kind", "prepare"), "--kind"),
        (("token", "create", "a\nb", "--scope", "read"), "NAME"),
        (("gc", "--days", "nan"), "--days"),
    ],
)
def test_other_commands_name_the_option(lightkiln, coordinator, command, option):
    done = lightkiln(*command, "--url", coordinator.url, "--token", coordinator.farm.token)
    if option == "JOB":
        assert done.code in (2, 3) and "UTF-8" in done.err, done
    else:
        check(done, option)


@pytest.mark.parametrize("name", ["Zoë's room, 2ⁿᵈ try", "x" * 128, "'; DROP TABLE jobs; --", "<b>"])
def test_names_that_are_only_unusual_are_kept(lightkiln, coordinator, lit_glb, name):
    flags = ("--url", coordinator.url, "--token", coordinator.farm.token, "--json")
    done = lightkiln("submit", lit_glb, *flags, "--name", name, "--label", f"k={name}")
    assert done.code == 0 and done.document["name"] == name and done.document["labels"] == {"k": name}
