"""What an installation does: it compiles the native engine and puts it into the wheel, or does without.

``TORCH_ECC_TARGET`` names one of ``build.TARGETS``: then it is compiled for that, by zig, or there is no wheel.
"""

from __future__ import annotations

import os
import sys
import sysconfig
import tempfile
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).parents[4]))

from torch_ecc.core.native.build import LIBRARIES, TARGETS, ZIG, BuildError, build, here


class EngineHook(BuildHookInterface):
    """Of hatchling."""

    def dependencies(self) -> list[str]:
        """Of the build alone."""
        return [ZIG] if "TORCH_ECC_TARGET" in os.environ else []

    def initialize(self, version: str, build_data: dict) -> None:
        """Before the wheel is made. An editable one has its libraries in the checkout."""
        name = os.environ.get("TORCH_ECC_TARGET")
        self.scratch = tempfile.TemporaryDirectory()
        try:
            target = TARGETS[name] if name else here()
            libraries = build(LIBRARIES if version == "editable" else Path(self.scratch.name), target)
        except (BuildError, OSError) as failure:  # OSError: where it was to be put
            if name:
                raise
            self.app.display_warning(f"torch_ecc: without its compiled engine, the slower torch page serves: {failure}")
            return
        platform = target.wheel or sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data |= {"pure_python": False, "tag": f"py3-none-{platform}"}
        if version != "editable":
            build_data["force_include"] |= {
                str(path): f"torch_ecc/core/native/{LIBRARIES.name}/{path.name}" for path in libraries
            }

    def finalize(self, version: str, build_data: dict, artifact_path: str) -> None:
        """After it."""
        self.scratch.cleanup()
