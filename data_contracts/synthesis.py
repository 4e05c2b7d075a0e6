"""Options of synthesis: an experiment whose synthetic data also becomes a plain folder of files."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, field_validator

from data_contracts.config import RUN_SETTING
from data_contracts.experiment import Experiment


class Synthesis(Experiment):
    """An experiment, and where its synthetic data goes for users of plain files."""

    export_folder: Path | None = Field(
        None,
        json_schema_extra=RUN_SETTING,
        description="a new folder for images, a table of labels and a description (data_contracts.image_folder), with "
        "event streams where `export` asks for them; null = the store alone",
    )

    @field_validator("export_folder")
    @classmethod
    def _is_absolute(cls, folder: Path | None) -> Path | None:
        return None if folder is None else folder.expanduser().absolute()
