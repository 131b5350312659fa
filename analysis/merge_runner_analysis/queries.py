"""The queries of queries.sql by name, for tables, pages and the report."""

from pathlib import Path

from merge_runner.paths import named_queries
from merge_runner.records import ANSWERS, NO_DECISION

QUERIES = named_queries(Path(__file__).with_name("queries.sql"))
# ``others`` is filled in later: the condition on a row of calls that another model answered.
COUNTED = QUERIES["counted_calls"].format(
    no_decision=NO_DECISION, answers=ANSWERS, others="{others}"
)
