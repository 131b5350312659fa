"""Fixtures for studies."""

import pytest

from merge_runner.run.plan import make_plan


@pytest.fixture
def plan_of(tmp_path, request):
    """Makes the plan of a study's text, below the ``HEAD`` of the module and beside a plug-in."""

    def plan(text, models=(), plugin=None, head=request.module.HEAD, **asked):
        file = tmp_path / "mine.toml"
        file.write_text(head + text)
        if plugin is not None:
            (tmp_path / "mine.py").write_text(plugin)
        return make_plan(str(file), models, trust=True, **asked)

    return plan
