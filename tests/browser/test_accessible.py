"""axe-core finds nothing serious in our own markup: every tab, both screens, both colour schemes."""

from __future__ import annotations

import pytest
from axe_playwright_python.sync_playwright import Axe

from browser.test_page import DESKTOP, PHONE, opened, press_and_wait, shown_clip

pytestmark = pytest.mark.seam

OURS = {"include": [["[class^='od-']:not([class^='od-'] *)"]]}
"""The outermost elements of ours: axe looks at all that is in them, and compares each with each of these."""

BRIEF = {"resultTypes": ["violations"]}


def assert_nothing_serious(page, where: str) -> None:
    # Colours on their way from one scheme to the other have any contrast.
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_function(
        "() => document.getAnimations().every(a => a.playState !== 'running'"
        " || a.effect.getComputedTiming().endTime === Infinity)"
    )
    found = [
        (violation["id"], node["target"], node.get("failureSummary", "")[:200])
        for violation in Axe().run(page, context=OURS, options=BRIEF).response["violations"]
        if violation["impact"] in ("serious", "critical")
        for node in violation["nodes"]
    ]
    assert not found, (where, found)


DIALOGS = {
    "Start": (("[data-revoke]", ".od-sure[open]"), (".od-account", ".od-menu:popover-open")),
    "Watch": (("[data-film]", ".od-film[open]"),),
    "Runs": (("[data-edit-run]", ".od-dialog[open]"),),
    "Data": ((".od-given >> text=Look", ".od-review[open] [data-frame]"),),
}
"""Of a tab: what opens each, and how it is known to be open."""


@pytest.mark.parametrize(
    ("viewport", "scheme"), [(DESKTOP, "light"), (PHONE, "dark")], ids=["desktop-light", "phone-dark"]
)
def test_nothing_serious_on_any_tab(chromium, site, viewport, scheme):
    from onedemo.app.http.tokens import issue_link, read_secret

    store = site.trainer.store
    new = store.accounts.ensure("new", "annotator")
    practice = issue_link(store, read_secret(store.path.parent), new, site.url)
    with opened(chromium, practice, viewport, color_scheme=scheme) as page:
        page.wait_for_selector("[data-introduction]")
        assert_nothing_serious(page, "introduction")
        page.click("[data-go]")
        page.wait_for_selector(".od-practice [data-frame]", timeout=60_000)
        assert_nothing_serious(page, "practice")
        page.keyboard.press("1")
        page.wait_for_selector(".od-feedback")
        assert_nothing_serious(page, "feedback")
    site.trainer.add_pairs(2)
    store.ratings.rate(site.trainer.add_clips(1)[0], new.id, 3, 900)
    store.runs.add_iteration(
        site.trainer.run, 1, snapshot=1, env_steps=16_000,
        stats={"predicted": 2.0, "kl": 0.01, "best": 2.5, "timeline": [None] * 20 + [2.0] * 20},
    )  # fmt: skip
    with opened(chromium, site.links["researcher"], viewport, color_scheme=scheme) as page:
        for tab, content in (
            ("Start", ".od-people tr"),
            ("Watch", ".od-gallery img"),
            ("Runs", ".od-runs"),
            ("Compare", ".od-pair [data-frame]"),
            ("Data", ".od-quality"),
            ("Guide", ".od-example [data-frame]"),
            ("Rate", ".od-clip [data-frame]"),
        ):
            page.click(f'.od-tabs >> text="{tab}"')
            page.wait_for_selector(content, timeout=60_000)
            if tab == "Start":
                page.fill("[name=names]", "Ann\nBob")
                page.click("text=Make links")
                page.wait_for_selector(".od-links svg", state="attached")
            assert_nothing_serious(page, tab)
            for opens, shown in DIALOGS.get(tab, ()):
                page.locator(opens).first.click()
                page.wait_for_selector(shown)
                assert_nothing_serious(page, shown)
                page.keyboard.press("Escape")
                page.wait_for_selector(shown, state="hidden")
        shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("s"))
        page.wait_for_selector(".od-notice")
        assert_nothing_serious(page, "a skip")
        page.keyboard.press("?")
        page.wait_for_selector(".od-help[open]")
        assert_nothing_serious(page, "keys")
        page.keyboard.press("Escape")
        page.wait_for_selector(".od-help", state="hidden")  # until then presses are not for the clip
        store.clips.set_state([c.id for c in store.clips.waiting(site.trainer.run)], "withdrawn")
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
        page.wait_for_selector(".od-waiting, .od-clip")
        assert_nothing_serious(page, "waiting")
