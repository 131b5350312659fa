"""The program, whose audit at a run's end takes for ever: it queries, or its file is held."""

import os
import sys
import time
from pathlib import Path

from merge_runner.audit.checks import audited_database
from merge_runner.cli import main
from merge_runner.run import run_record


def begun(path, sweep_id):
    if "QUERIES" not in os.environ:
        sys.stderr.write("the audit begins\n")
        while not Path("held").exists():
            time.sleep(0.01)
    return audited_database(path, sweep_id)


def checked(connection, *_, **__):
    sys.stderr.write("the audit begins\n")
    sql = f"SELECT count(*) FROM range({10**15}) WHERE hash(range) = 7"
    return connection.execute(sql).fetchall()


if __name__ == "__main__":
    run_record.audited_database, run_record.check_sweep = begun, checked
    main()
