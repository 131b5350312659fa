"""Played calls leave no reference cycles: a sweep collects garbage rarely."""

import gc
from weakref import ref

from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from tests.support.harness import run_sweep


async def test_a_further_call_leaves_no_object_in_a_reference_cycle(tmp_path, monkeypatch):
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)

    async def left_by(seconds: int) -> tuple[int, int]:
        """Numbers of live calls, and of objects in cycles that they leave."""
        study = tmp_path / f"{seconds}.toml"
        study.write_text(f"repetitions = {{ baseline = 1 }}\nscenario.timeout_s = {seconds}\n")
        plan = make_plan(str(study), "emulator", conditions=["L_4_0"], trust=True)
        options = Options(tmp_path / f"{seconds}.duckdb", tmp_path / f"{seconds}", quiet=True)
        gc.collect()
        gc.disable()
        gc.set_debug(gc.DEBUG_SAVEALL)
        try:
            summary = await run_sweep(plan, options, say=lambda _: None)
            gc.collect()
            left = sum(not isinstance(found, ref) for found in gc.garbage)
            return summary["calls"]["live"], left
        finally:
            gc.set_debug(0)
            gc.garbage.clear()
            gc.enable()

    await left_by(2)  # the first one loads what is loaded once
    (few_calls, few), (many_calls, many) = await left_by(3), await left_by(8)
    assert many_calls > few_calls
    assert many - few < many_calls - few_calls
