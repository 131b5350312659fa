"""A query, its result, and what can be asked for."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence

from starlette.responses import Response

from merge_runner.errors import MergeRunnerError
from merge_runner.results.export import tables, units
from merge_runner.text_safety import quoted
from merge_runner_analysis.web.display_text import visible
from merge_runner_analysis.web.queries import DOWNLOADED_ROWS, LONGEST
from merge_runner_analysis.web.scope import carried, scope_of
from merge_runner_analysis.web.site import Site, download

# Whoever asks while the schema is listed for the first time waits for it.
LISTING = threading.Lock()
# Types of which values stand to the right.
NUMBER = re.compile(r"U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?|FLOAT|DOUBLE|BIGNUM|DECIMAL\(.*\)")

# SQL conditions for each part of a scope.
SCOPED = {
    "sweep": "(trial_id, spec_hash) in (select trial_id, spec_hash from sweep_trials\n"
    "    where sweep_id in ({}))",
    "model": "driver in ({})",
    "variant": "variant in ({})",
    "condition": "condition in ({})",
}
# Queries to begin with.
EXAMPLES = {
    "Who merged first, and how often did they collide?": """\
select model_left, variant, condition, count(*) as trials,
    count(*) filter (where merged_first = 'left') as left_first,
    count(*) filter (where merged_first = 'right') as right_first,
    count(*) filter (where status = 'collided') as collided
from trials
group by all order by all""",
    "Gap at the merge point, speed deviation, and joint contribution per variant": """\
select variant, count(gap_m) as n, round(avg(gap_m), 2) as gap_m,
    round(avg(rmse_mps), 2) as rmse_mps, round(100 * avg(joint::int), 1) as joint_percent
from trials join trial_metrics using (trial_id, spec_hash)
group by all order by all""",
    "What did the drivers say in the trials that ended in a collision?": """\
select trial_id, side, time_s, tactical, rationale
from decisions join trials using (trial_id, spec_hash)
where status = 'collided'
order by trial_id, decision, side
limit 20""",
}


def sql_page(site: Site, params: Mapping[str, str]) -> str:
    """Return the page of a query, with its result."""
    query = query_in(params)
    is_asked, result, problem = bool(query.strip()), None, None
    if is_asked:
        try:
            result = site.queries.result(query)
        except MergeRunnerError as exc:
            problem = visible(str(exc))
    names = [name for name, _ in result.columns] if result else []
    with LISTING:
        schema = tables()
    return site.render(
        "sql.html",
        view="sql",
        bar=scope_of(site, params, any_prompt=True),
        carried=carried(params),
        query=query if is_asked else scoped_query(carried(params)),
        asked=is_asked,
        longest=LONGEST,
        examples=EXAMPLES,
        tables=schema,
        units=units(),
        problem=problem,
        result=result,
        spec=names.index("spec_hash") if "spec_hash" in names else None,
        is_number=NUMBER.fullmatch,
        most=DOWNLOADED_ROWS,
    )


def sql_csv(site: Site, params: Mapping[str, str]) -> Response:
    """Return the whole result of a query as a file; raises UsageError."""
    return download(site.queries.csv(query_in(params)), "query.csv")


def scoped_query(chosen: Mapping[str, Sequence[str]]) -> str:
    """Return a query of the trials of a scope; the first example where none is chosen."""
    if not chosen:
        return next(iter(EXAMPLES.values()))
    parts = [SCOPED[name].format(", ".join(map(quoted, of))) for name, of in chosen.items()]
    return (
        "select trial_id, status, merged_first, gap_m\n"
        "from trials join trial_metrics using (trial_id, spec_hash)\n"
        "    join trial_drivers using (trial_id, spec_hash)\nwhere " + "\n    and ".join(parts)
    )


def query_in(params: Mapping[str, str]) -> str:
    """Return the query in an address; a form ends its lines with CR LF."""
    return params.get("q", "").replace("\r\n", "\n")
