"""The report: one file that needs nothing else, and says what can and cannot be concluded."""

import re
import struct
from dataclasses import replace

import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.figures.gallery import rendered, write_figures
from merge_runner_analysis.figures.style import PAGE_IN
from merge_runner_analysis.provenance import provenance, tally
from merge_runner_analysis.published import published
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import TABLES, make_tables
from merge_runner_analysis.web.report import report_html, write_report
from tests.support.serving import words_of
from tests.support.studies import Said, changed, write_study, yielding
from tests.support.tables import alarms_of


class Page:
    """What a page refers to and what it shows."""

    def __init__(self, text):
        self.tags = {*re.findall(r"<(\w+)", text)}
        self.ids, self.links, self.sources = (
            re.findall(rf'<[^>]* {name}="([^"]*)"', text) for name in ("id", "href", "src")
        )
        self.text = words_of(text)


@pytest.fixture(scope="module")
def page(study, tables):
    return Page(report_html(study, list(tables.values()), dict.fromkeys(FIGURES, "PHN2Zy8+")))


def test_the_page_needs_no_network_runs_nothing_and_every_link_leads_somewhere(page):
    assert {"script", "link", "iframe", "object"}.isdisjoint(page.tags)
    assert len(page.sources) == len(FIGURES)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    assert all(link.startswith("#") for link in page.links)
    assert {link[1:] for link in page.links} <= {*page.ids}
    assert len(page.ids) == len({*page.ids})


def test_every_table_and_reading_is_on_the_page_with_the_trials_behind_its_numbers(page):
    assert {*TABLES} <= {*page.ids}
    for point in published("readings")["point"]:
        assert " ".join(point.split()) in page.text
    assert "o3/A1/L_4_8/rep05" in page.text
    assert "merge-runner sql" in page.text


def test_a_report_begins_with_the_description_the_design_the_prompts_and_the_factors(tmp_path):
    drives = [*yielding("o3", reps=1)[:3], *yielding("o3", "A1", reps=1)[:3]]
    asked = {"endpoint": "openai", "body": {"model": "o3", "messages": [], "temperature": 0.2}}
    of, long = {"description": "Who is <first>?"}, ScenarioConfig(vehicle_length_m=8.0)
    study = changed(
        write_study(tmp_path / "t.duckdb", drives, long, config=of, asked=asked),
        "UPDATE decisions SET prompt = 'Drive.\n' || CASE WHEN trial_id LIKE '%/A1/%' "
        "THEN 'You are late.' ELSE 'There is time.' END",
    )
    text = report_html(study, make_tables(study, ["factors", "gap"]), {})
    assert "Read this first" not in text
    conditions = ", ".join(sorted(study.conditions))
    parts = ["Who is &lt;first&gt;?</h1>", 'id="design"', conditions, "There is time.",
             "-There is time.\n+You",
             'id="conclusions"', 'id="factors"', 'id="gap"']  # fmt: skip
    places = [text.index(part) for part in parts]
    assert places == sorted(places)
    assert text.count('id="factors"') == 1
    assert "temperature = 0.2" in text
    assert "vehicle_length_m = 8.0" in text


def test_figures_that_show_the_same_are_not_drawn(tmp_path):
    study = StudyResults(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)))
    said = []
    (out,) = write_report(study, tmp_path / "report.html", None, said.append)
    assert said[1:] == ["drawing figure2", "drawing first-action"]
    assert len(Page(out.read_text()).sources) == 2


def asking(folder, said, *, variant="baseline"):
    """A study of o3 in which the first six trials had this said at their first decision."""
    drives = [replace(d, said={0: said}) for d in yielding("o3", variant, reps=1)[:6]]
    return StudyResults(write_study(folder / "t.duckdb", drives))


def test_what_went_wrong_stands_at_the_top_before_any_number(page):
    warnings, _, _ = page.text.partition("What can be concluded")
    assert "Read this first" in warnings
    for said in (
        "Another model answered. other was asked for, impostor answered: 3 answers, in sweep-1.",
        "Trials failed. 1 of 44 of other/baseline (no answer after 2 attempts).",
        "Many fallbacks. 55 of 906 decisions of o3/A2 (6.07 %).",
        "Attempts of unknown fate. 1 of 896 of o3/A1.",
    ):
        assert said in warnings


def test_a_study_in_which_nothing_went_wrong_has_no_warning(tmp_path):
    assert alarms_of(asking(tmp_path, Said(), variant="A1")) == {}


def test_the_fallbacks_of_a_group_are_unusual_above_one_in_twenty(tmp_path):
    study = asking(tmp_path, Said(failure="no_array"))
    found = tally(study, study.models[0])
    assert found["fallback"] == 6
    assert 0.05 < found["fallback"] / found["decisions"] < 0.07
    ((title, text),) = alarms_of(study).items()
    assert title == "Many fallbacks"
    assert "6 of" in text
    fewer = "UPDATE decisions SET fallback = false WHERE trial_id LIKE '%R_-4_-8%'"
    assert alarms_of(changed(study.db, fewer)) == {}


def test_a_driver_under_two_specs_is_named(small, tmp_path):
    db = tmp_path / "t.duckdb"
    db.write_bytes(small.db.read_bytes())
    study = changed(
        db,
        *(
            f"INSERT INTO {name} SELECT * REPLACE ('changed' AS spec_hash) FROM {name} "
            "WHERE trial_id LIKE '%N_0_0%'"
            for name in ("trials", "states", "decisions")
        ),
    )
    ((title, text),) = alarms_of(study).items()
    assert title == "Several settings under one name"
    assert text.startswith("o3, o3 [changed].")


def test_the_report_says_what_the_replies_cost_by_model(study, page):
    models = provenance(study.db).model_costs.set_index("driver")
    # Every attempt cost a cent but the one of unknown fate.
    assert models["attempts"].to_dict() == {"o3": 3510, "other": 705}
    assert models["cost_usd"].to_dict() == pytest.approx({"o3": 35.09, "other": 7.05})
    assert models["attempts_of_unknown_cost"].to_dict() == {"o3": 1, "other": 0}
    assert "35.09" in page.text
    assert "Attempts of unknown cost are not in the sums" in page.text


def test_a_call_that_several_trials_used_was_made_and_paid_once(tmp_path):
    study = changed(
        asking(tmp_path, Said(("timeout", "ok"))).db,
        "DELETE FROM calls WHERE decision > 0 OR side = 'right'",
        "UPDATE calls SET call_key = 'k'",
    )
    (row,) = provenance(study.db).calls.itertuples()
    assert (row.calls, row.retries, row.cost_usd) == (1, 1, 0.02)


def test_the_report_writes_all_its_parts_as_files(tmp_path):
    study = StudyResults(write_study(tmp_path / "t.duckdb", yielding("o3", reps=1)[:4]))
    out, files = tmp_path / "r/report.html", tmp_path / "r/files"
    written = {*write_report(study, out, files)}
    parts = {f"{name}.{form}" for name in FIGURES for form in ("pdf", "svg", "png")}
    parts |= {f"{name}.{form}" for name in TABLES for form in ("txt", "csv", "json", "md", "tex")}
    assert written == {out, *(files / part for part in parts)}
    assert all(path.stat().st_size > 50 for path in written)
    pdf = (files / "figure2.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert float(box[1]) == pytest.approx(72 * PAGE_IN, abs=0.5)
    assert b"/Type /Font" in pdf, "text stays text"
    width, _ = struct.unpack(">II", (files / "figure2.png").read_bytes()[16:24])
    assert width == round(300 * PAGE_IN)
    for form in ("pdf", "svg", "png"):  # equal results give equal files
        again = rendered(StudyResults(study.db), "first-action", form)
        assert again == (files / f"first-action.{form}").read_bytes()
    with pytest.raises(UsageError, match="cannot be made"):
        list(write_figures(study, out))
    with pytest.raises(UsageError, match="cannot be written"):
        list(write_report(study, tmp_path, None))
