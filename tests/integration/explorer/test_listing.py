"""The list of trials: what it sums up, what its sparklines show, and names that hide something."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.pictures import sparkline, speed_range
from merge_runner_analysis.explorer.site import Site
from tests.support.exporting import export
from tests.support.studies import Drive, as_humans, write_study, yielding

HOST = "127.0.0.1:8700"
HIDDEN = "o3\u202egpj\u200b"
# It brakes until it stands, between samples of a sparkline too.
STANDING = Drive(HIDDEN, "baseline", "N_0_0", 1, (-1.0,) * 5, (0.9,) * 2)


class Texts(HTMLParser):
    """What a page shows or says: texts, and the attributes that are read out."""

    def __init__(self, text):
        super().__init__()
        self.said = []
        self.feed(text)

    def handle_data(self, data):
        self.said.append(data)

    def handle_starttag(self, tag, attrs):
        self.said += [value for name, value in attrs if name in {"aria-label", "title"}]


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Two drivers, one of whom has an odd name, and humans with another mean gap."""
    path = tmp_path_factory.mktemp("listing") / "t.duckdb"
    others = [*yielding("human", reps=1)[:5], *yielding("o3", "A1", reps=1)[:3]]
    write_study(path, [STANDING, *yielding("o3", reps=1), *others])
    as_humans(path)
    return path


@pytest.fixture(scope="module")
def client(db):
    return TestClient(explorer(Site(db)), base_url=f"http://{HOST}")


def summary(text):
    return [
        " ".join(Texts(part).said).split()
        for part in re.search(r'class="totals".*?</div>', text, re.DOTALL)[0].split("<p>")[1:]
    ]


def test_humans_and_drivers_are_summed_up_apart(client, db):
    with duckdb.connect(str(db), read_only=True) as connection:
        means = connection.execute(
            "SELECT format('{:.2f}', avg(gap_m)) FROM trials JOIN trial_metrics "
            "USING (trial_id, spec_hash) GROUP BY source = 'human' ORDER BY source = 'human'"
        ).fetchall()
    drivers, humans = (" ".join(words) for words in summary(client.get("/trials").text))
    assert drivers.startswith("drivers: 15 trials")
    assert humans.startswith("humans: 5 trials")
    assert [re.search(r"mean gap (\S+)", line)[1] for line in (drivers, humans)] == [
        mean for (mean,) in means
    ]
    assert means[0] != means[1]
    alone = [" ".join(words) for words in summary(client.get("/trials?model=human").text)]
    assert alone == [humans]


def test_a_sparkline_cuts_nothing_and_the_page_says_its_scale(client, db):
    site = Site(db)
    site.catalogue.refresh()
    rows = site.catalogue.every({}, page=1)
    with duckdb.connect(str(db), read_only=True) as connection:
        ((slowest, fastest),) = connection.execute(
            "SELECT min(velocity_mps), max(velocity_mps) FROM states"
        ).fetchall()
    assert slowest == 0
    low, high = speed_range(rows)
    assert low <= slowest < fastest <= high
    heights = {
        side: [float(point.partition(",")[2]) for point in line[side].split()]
        for line in [sparkline(row, (low, high)) for row in rows]
        for side in ("left", "right")
    }
    assert all(0 <= y <= 22 for line in heights.values() for y in line)
    standing = next(row for row in rows if row["model"] == HIDDEN)
    assert sparkline(standing, (low, high))["left"].endswith(",22.0")
    text = client.get("/trials").text
    assert f"{low} to {high} m/s</small></th>" in text
    assert "speed of the left vehicle 0.0 to 10.0 m/s" in text


@pytest.mark.parametrize(
    "address",
    [
        "/trials",
        "/trials?model=none%E2%80%AE",
        f"/trials/{HIDDEN}/baseline/N_0_0/rep01",
        f"/trials/{HIDDEN}",
        f"/discordant?model={HIDDEN}&variant=A1",
    ],
)
def test_a_name_that_hides_something_is_neutral(client, address):
    said = "".join(Texts(client.get(address).text).said)
    assert "[U+202E]" in said
    assert not {"\u202e", "\u200b"} & set(said)


@pytest.mark.slow
def test_a_name_that_hides_something_is_neutral_on_every_page_of_an_export(
    db, tmp_path, monkeypatch
):
    monkeypatch.setattr("merge_runner_analysis.explorer.catalogue.PAGE", 7)
    monkeypatch.setattr("merge_runner_analysis.explorer.pages.trials.PAGE", 7)
    files = export(db, tmp_path / "pages", ["*"])
    assert len([*files.glob("trials-page-*.html")]) == 2
    for page in tmp_path.glob("pages/**/*.html"):
        said = Texts(page.read_text()).said
        assert not any({"\u202e", "\u200b"} & set(text) for text in said)
    lists = [(tmp_path / "pages/index.html"), *files.glob("trials-page-*.html")]
    assert sum("o3[U+202E]gpj[U+200B]" in page.read_text() for page in lists) == 1


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"outcome": "crashed"},
            "Of outcome there is no crashed; there are left first, right first.",
        ),
        ({"model": "o4"}, "Of driver there is no o4; there are human, o3, "),
        ({"factor.hurry": "yes"}, "Of hurry there is no yes."),
        ({"q": "nowhere"}, "No trial matches. Show all"),
        ({"outcome": "left first", "variant": "A1"}, "No trial matches. Show all"),
    ],
)
def test_an_empty_list_names_the_values_that_no_trial_has(client, asked, said):
    text = client.get("/trials", params=asked).text
    empty = re.search(r'<p class="empty">.*?</p>', text, re.DOTALL)[0]
    assert said in " ".join("".join(Texts(empty).said).split())
    assert "trials.csv" not in text
