"""Many sessions in one command: each is scanned and measured as by hand, on the cores of one machine or of a Dask cluster.

In: captures (or clouds), a rig, the commands to be done with each, and what of an earlier run can be kept.
Out: one row a session with its exit status, reason and figures, as CSV or Parquet; the day in figures and on a page.
Read: steps, session, figures, table, journal, cluster, line, engine, statistics, wording. Work of any other kind: `each`.
"""

from scope.batch.engine import Day, DayOptions, run_day
from scope.batch.line import each
from scope.batch.session import Answer, Job, Outcome, run_session, sessions_of
from scope.batch.statistics import Chart, GaugeStudy, capability, control_chart, gauge_study
from scope.batch.steps import Step, parse_steps
from scope.batch.table import read_rows, require_table, write_rows
from scope.batch.wording import day_page, day_result, day_text

__all__ = [
    "Answer",
    "Chart",
    "Day",
    "DayOptions",
    "GaugeStudy",
    "Job",
    "Outcome",
    "Step",
    "capability",
    "control_chart",
    "day_page",
    "day_result",
    "day_text",
    "each",
    "gauge_study",
    "parse_steps",
    "read_rows",
    "require_table",
    "run_day",
    "run_session",
    "sessions_of",
    "write_rows",
]
