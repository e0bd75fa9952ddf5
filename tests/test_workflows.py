"""What runs elsewhere and cannot be tried here: workflow files are read, and test the oldest versions that we claim."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
yaml = pytest.importorskip("yaml")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_workflows_are_what_they_should_be(path):
    """A colon too many makes a file that nobody runs."""
    told = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert told["permissions"] == {"contents": "read"}
    for job in told["jobs"].values():
        assert ("uses" in job) != ("runs-on" in job and "steps" in job)
        assert set(job.get("needs", [])) <= told["jobs"].keys() or job["needs"] in told["jobs"]
        for step in job.get("steps", []):
            assert len({"run", "uses"} & step.keys()) == 1
            assert isinstance(step.get("run", ""), str)


def test_the_oldest_versions_are_those_that_we_claim():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    bounds = dict(re.match(r"([\w-]+)>=([\d.]+)", each).groups() for each in project["dependencies"])
    job = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))["jobs"]["oldest"]
    text = "\n".join(str(step.get("run", step.get("with"))) for step in job["steps"])
    assert f"torch=={bounds['torch']}" in text
    assert f"'{project['requires-python'].removeprefix('>=')}'" in text
