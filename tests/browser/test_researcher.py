"""What a researcher sees and does, in a real browser, at both sizes."""

from __future__ import annotations

import csv
import io
import math

import pyarrow.parquet as pq
import pytest

from browser.test_page import DESKTOP, GUARD_MS, SMALL, opened, until
from onedemo.app.cli.main import main
from onedemo.app.dataset.columns import SKIPS
from onedemo.storage.rating_records import SKIP_COLUMNS

pytestmark = pytest.mark.seam


def rate_some(site):
    store = site.trainer.store
    store.database._db.execute("PRAGMA synchronous = OFF")
    ids = site.trainer.add_clips(30)
    ann, bob = (store.accounts.ensure(name, "annotator").id for name in ("Ann", "Bob <i>"))
    for k, clip in enumerate(ids):
        store.ratings.rate(clip, ann, k % 5 + 1, 1500, mark=(13, 25) if k == 0 else None)
        store.ratings.rate(clip, bob, 3, 320)
        if k % 10 == 0:
            store.ratings.rate(clip, ann, k % 5 + 1, 1500, repeat=True)
    return ids


def to_tab(page, name):
    page.click(f'.od-tabs >> text="{name}"')


def test_whether_ratings_are_good_and_who_is_left_out(chromium, site):
    rate_some(site)
    store, run = site.trainer.store, site.trainer.run
    bob = {rater.name: rater.id for rater in store.accounts.raters()}["Bob <i>"]
    with opened(chromium, site.links["researcher"], SMALL) as page:
        to_tab(page, "Data")
        page.wait_for_selector(".od-quality >> text=30 clips", timeout=20_000)
        page.wait_for_selector(".od-quality >> text=100 %")  # the second looks
        page.wait_for_selector("text=nearly always says 3")
        page.wait_for_selector("text=100 % of the answers came before the clip had played once")
        row = page.locator("tr", has_text="Bob <i>").first
        row.locator("[data-do]").click()
        until(lambda: store.ratings.left_out(run) == {bob})
        page.wait_for_selector(".od-left-out >> text=Bob <i>", timeout=20_000)
        assert {rating.value for rating in store.ratings.for_training(run)} == {1, 2, 3, 4, 5}
        assert len(store.ratings.for_training(run)) == 30
        assert page.locator(".od-nobody").count() == 0
        page.locator("tr", has_text="Ann").first.locator("[data-do]").click()
        page.wait_for_selector(".od-nobody >> text=Everybody is excluded from training.", timeout=20_000)
        to_tab(page, "Watch")
        page.wait_for_selector(".od-nobody:visible >> text=continues with its last reward model")
        assert site.trainer.store.ratings.count_for_training(run) == 0
        to_tab(page, "Data")
        for name in ("Ann", "Bob <i>"):
            row = page.locator(".od-left-out", has_text=name).locator('[data-do="include"]')
            row.click()
            page.wait_for_selector(f'.od-left-out:has-text("{name}")', state="detached", timeout=20_000)
        until(lambda: store.ratings.left_out(run) == set())
        page.wait_for_selector(".od-nobody", state="detached")
        assert len(store.ratings.for_training(run)) == 60


def test_skips_and_their_reasons_are_counted_and_exported(chromium, site, tmp_path):
    store, ids = site.trainer.store, site.trainer.add_clips(3)
    ann = store.accounts.ensure("=Ann", "annotator").id
    store.ratings.skip(ids[0], ann, 700)
    store.ratings.skip(ids[0], ann, 0, reason="It is too short to tell")
    store.ratings.skip(ids[1], ann, 800)
    store.ratings.skip(ids[2], ann, 900)
    store.ratings.undo(ids[2], ann)
    with opened(chromium, site.links["researcher"], SMALL) as page:
        to_tab(page, "Data")
        row = page.locator('[aria-label="Raters"] tr', has_text="=Ann").first
        row.wait_for(timeout=20_000)
        assert row.locator("td").all_inner_texts()[:2] == ["0", "2"]
        text = page.request.get(f"{site.url}/skips.csv?run={site.trainer.run}").text()
    out = tmp_path / "skips.csv"
    assert main(["export", "--data-dir", str(store.path.parent), "--skips", str(out)]) == 0
    assert out.read_text() == text.replace("\r\n", "\n")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert tuple(rows[0]) == tuple(SKIPS) == SKIP_COLUMNS
    assert [(int(r["clip_id"]), r["rater"], r["reason"], r["latency_ms"]) for r in rows] == [
        (ids[0], "'=Ann", "It is too short to tell", "700"), (ids[1], "'=Ann", "", "800"),
    ]  # fmt: skip


def test_ratings_are_filtered_previewed_and_downloaded(chromium, site, tmp_path):
    ids = rate_some(site)
    with opened(chromium, site.links["researcher"], SMALL) as page:
        to_tab(page, "Data")
        page.wait_for_selector(".od-filter")
        page.click(".od-choose summary")
        page.check('.od-choose input[value="Ann"]')
        page.select_option('.od-filter [name="value"]', "2")
        page.click(".od-filter >> text=Preview")
        page.wait_for_selector(".od-preview >> text=all 6 ratings")

        def download(text):
            with page.expect_download() as given:
                page.click(f".od-downloads >> text={text}")
            file = tmp_path / given.value.suggested_filename
            given.value.save_as(file)
            return file

        rows = list(csv.DictReader(io.StringIO(download("Download CSV").read_text())))
        assert len(rows) == 6 and {(row["rater"], row["value"]) for row in rows} == {("Ann", "2")}
        assert pq.read_table(download("Segments")).column("clip_id").to_pylist() == ids
        assert "Krippendorff" not in (card := download("Data card").read_text()) and "| `value` |" in card
        for path in ("/preview?rater[]=x", "/export.csv?value=a", "/export.csv?id=1"):
            assert page.request.get(site.url + path).status == 400
    with opened(chromium, site.links["annotator"]) as page:
        for path in (
            "/preview",
            "/segments.parquet",
            "/card.md",
            "/comparisons.csv",
            "/skips.csv",
            "/rollouts/1.jpg",
        ):
            assert page.request.get(site.url + path).status == 403, path
        body = {"do": "exclude", "rater": 1}
        origin = {"Origin": site.url}
        assert page.request.post(f"{site.url}/r/2/do", data=body, headers=origin).status == 403


def test_parts_of_the_demo_and_the_best_rollouts(chromium, site):
    for k in range(1, 4):
        timeline = [None if i > 35 else round(2 + math.sin(i / 6), 2) for i in range(40)]
        site.trainer.store.runs.add_iteration(
            site.trainer.run, k, snapshot=k, env_steps=16000 * k,
            stats={"predicted": 2.0, "kl": 0.01, "best": 2.5 + k / 10, "timeline": timeline},
        )  # fmt: skip
    with opened(chromium, site.links["researcher"], SMALL) as page:
        page.wait_for_selector(".od-parts >> text=iteration 3; between 1.0 and 3.0; weakest at 5.7 s")
        assert (
            page.locator(".od-cells i").count() == 40 and page.locator(".od-cells [data-none]").count() == 4
        )
        page.wait_for_selector(".od-gallery >> text=predicted rating 2.8")
        page.locator(".od-gallery button").first.scroll_into_view_if_needed()
        page.wait_for_function("() => document.querySelector('.od-gallery img').naturalWidth > 0")
        page.click("[data-film]")
        page.wait_for_function("() => document.querySelector('.od-film video').currentTime > 0.1")
        page.keyboard.press("Escape")
        with page.expect_download() as given:
            page.click("text=Download")
        assert given.value.suggested_filename == "onedemo-iteration-3.webm"


def test_runs_side_by_side(chromium, site):
    store = site.trainer.store
    store.runs.add(
        run="hop-1", demo="hopper-hop", demo_sha256="0", seed=4, config='method = "paper"\n', version="0"
    )
    for run, above in ((site.trainer.run, 1.0), ("hop-1", 0.0)):
        for k in range(1, 6):
            stats = {"predicted": 2 + above + k / 10, "kl": 0.01, "true_reward": 100.0 * k}
            store.runs.add_iteration(run, k, snapshot=k, env_steps=16000 * k, stats=stats)
    with opened(chromium, site.links["researcher"], SMALL) as page:
        to_tab(page, "Runs")
        page.wait_for_selector(".od-runs >> text=hop-1")
        cells = page.locator('tr[data-run="hop-1"]').locator("th, td").all_inner_texts()
        assert cells[0].split("\n") == ["hop-1", "hopper learns hopper-hop, paper, seed 4"]
        assert [cell.replace("\xa0", " ") for cell in cells[1:6]] == [
            "Stopped", "0", "80 k of 10.00 M", "2.5 of 5", "500 points",
        ]  # fmt: skip
        page.set_viewport_size(DESKTOP)
        numbers = page.locator(".od-runs tbody tr").first.locator(".od-number")
        assert numbers.evaluate_all("all => all.map(n => getComputedStyle(n).textAlign)") == ["right"] * 4
        assert page.locator(".od-current .od-run-name").inner_text() == site.trainer.run
        until(lambda: page.locator(".uplot").count() == 2)
        assert page.locator('[data-compare][aria-pressed="true"]').count() == 2
        for label in ("Pause", "Resume"):
            page.click(f'.od-current >> text="{label}"')
        until(lambda: [call for call in site.trainer.calls if call != "pairs"] == ["pause", "resume"])
        page.fill('.od-new-run [name="name"]', "another")
        page.click(".od-new-run >> text=Start the run")
        page.wait_for_selector(".od-form-note >> text=There is this run alone")
        for viewport in ({"width": 390, "height": 844}, {"width": 820, "height": 1180}, DESKTOP):
            page.set_viewport_size(viewport)
            for button in page.locator(
                'tr[data-run="hop-1"] button'
            ).all():  # none is behind a sideways scroll
                box = button.bounding_box()
                assert box["x"] >= 0 and box["x"] + box["width"] <= viewport["width"], viewport


def test_any_of_fifty_runs_is_compared_and_branched_from(chromium, site):
    store = site.trainer.store
    for seed in range(50):
        name = f"hop-{seed}"
        store.runs.add(
            run=name, demo="hopper-hop", demo_sha256="0", seed=seed, config='method = "paper"\n', version="0"
        )
        store.runs.add_iteration(name, 1, snapshot=1, env_steps=16000, stats={"predicted": 2.0, "kl": 0.01})
    with opened(chromium, site.links["researcher"], SMALL) as page:
        to_tab(page, "Runs")
        page.wait_for_selector(".od-which >> text=6 runs drawn")

        def legend():
            said = page.locator(".od-legend-of-chart").first.locator("span").all_inner_texts()
            return [line.rsplit(" ", 1)[0] for line in said]

        newest = [f"hop-{k}" for k in range(49, 44, -1)]
        until(lambda: legend() == [*newest, site.trainer.run])
        page.locator('[data-compare="hop-0"]').click()
        until(lambda: legend() == [*newest, "hop-0", site.trainer.run])
        page.locator('[data-compare="hop-47"]').click()
        until(lambda: "hop-47" not in legend())
        page.click(".od-which >> text=Clear")
        page.wait_for_selector(".od-which >> text=No run is drawn")
        assert page.locator('[data-compare][aria-pressed="true"]').count() == 0
        chosen = [f"hop-{k}" for k in range(12, -1, -1)]
        for name in chosen:
            page.locator(f'[data-compare="{name}"]').click()
            on = f'[data-compare="{name}"][aria-pressed="true"]'
            page.wait_for_selector(f"{on}, .od-which:has-text('12 of the 13')")
        page.wait_for_selector(".od-which >> text=12 of the 13 chosen runs are drawn")
        until(lambda: legend() == chosen[:12])
        page.click(".od-which >> text=The newest ones")
        until(lambda: legend() == [*newest, site.trainer.run])
        assert site.events() == []
        page.select_option('.od-new-run [name="predictor_from"]', "hop-0")
        table = page.locator(".od-runs .od-scroll").bounding_box()
        assert table["height"] < 730


def test_pairs_are_compared_with_the_keys_of_ratings(chromium, site):
    site.trainer.add_pairs(4)
    with opened(chromium, site.links["researcher"]) as page:
        to_tab(page, "Compare")

        def shown():
            page.wait_for_selector(".od-pair [data-frame]", timeout=60_000)
            page.wait_for_timeout(GUARD_MS)
            return int(page.locator(".od-pair > div").get_attribute("data-pair"))

        def answers():
            return [(row[1], row[5]) for row in site.trainer.store.comparisons.stream()]

        expected = []
        for act, answer in (
            (lambda: page.keyboard.press("1"), "left"),
            (lambda: page.click('.od-answers [data-key="3"]'), "right"),
            (lambda: page.keyboard.press("2"), "equal"),
        ):
            expected.append((shown(), answer))
            act()
            until(lambda: answers() == expected)
            page.wait_for_selector(f'[data-pair="{expected[-1][0]}"]', state="detached")
        shown()
        page.keyboard.press("u")
        until(lambda: answers() == expected[:-1])
        page.wait_for_selector(f'[data-pair="{expected[-1][0]}"]')
        assert shown() == expected[-1][0]
        page.keyboard.press("s")
        until(lambda: page.locator(f'.od-player[data-pair="{expected[-1][0]}"]').count() == 0)
        assert answers() == expected[:-1]
        page.click(".od-notice >> text=Too short to tell")
        page.wait_for_selector(".od-notice >> text=Noted. Thank you.")
        skipped = site.trainer.store.database.rows("SELECT reason FROM comparisons WHERE answer = 'skip'")
        assert skipped == [(None,), ("Too short to tell",)]
        assert "pairs" in site.trainer.calls and site.events() == []
        bottom = page.locator(".od-tools").bounding_box()
        assert bottom["y"] + bottom["height"] <= DESKTOP["height"]
        page.keyboard.press("?")
        help = page.locator(".od-help:visible")
        assert "the left one is closer" in help.inner_text() and "mark" not in help.inner_text()


def test_any_rating_is_looked_at_and_withdrawn_with_a_reason(chromium, site):
    from onedemo.app.dataset.card import card

    store, run = site.trainer.store, site.trainer.run
    ids = [clip.id for clip in store.clips.waiting(run)]
    for name in ("Ann", "Bob <i>"):
        rater = store.accounts.ensure(name, "annotator").id
        for clip, value in zip(ids, (5, 1, 4), strict=False):
            store.ratings.rate(clip, rater, value, 900)
    with opened(chromium, site.links["researcher"]) as page:
        page.click('.od-tabs >> text="Data"')
        rows = page.locator(".od-given tbody tr")
        rows.first.wait_for()
        assert rows.count() == 6 and page.locator(".od-given tbody i").count() == 0
        page.select_option(".od-given select", "Ann")
        until(lambda: page.wait_for_timeout(20) or rows.count() == 3)
        page.click('.od-given tr:has(b:text-is("5")) >> text=Look')
        review = page.locator(".od-review")
        review.locator(".od-player[data-frame]").wait_for()
        assert "Ann: 5, The same" in review.inner_text() and f"of clip {ids[0]}" in review.inner_text()
        review.locator("input[name=reason]").fill("<b>pressed 5</b> by mistake")
        review.locator("text=Withdraw").last.click()
        page.wait_for_selector(".od-given tr >> text=Withdrawn by ada: <b>pressed 5</b> by mistake")
        assert not review.is_visible() and store.ratings.count_for_training(run) == 5
        page.locator(".od-given tr.od-left-out >> text=Look").click()
        review.locator(".od-player[data-frame]").wait_for()
        assert not review.locator("[data-withdraw]").is_visible()
    said = [line for _, who, what, line in store.audit.lines() if (who, what) == ("ada", "withdraw")]
    assert len(said) == 1 and "pressed 5" in said[0] and "rating 1" in said[0]
    assert "| 1 | 1 | Ann | 5 | &lt;b&gt;pressed 5&lt;/b&gt; by mistake |" in card(store, run)
