"""Every option of the program: typed, with unit, range and one line of help; TOML in and out."""

from sfm_app.settings.all_settings import QUALITY_PRESETS, Settings, merge_nested
from sfm_app.settings.tables import (
    LOCAL_ADDRESS,
    CalibrationSettings,
    ClusterSettings,
    ConstraintForm,
    DepthSettings,
    EpipolarSettings,
    MatchSettings,
    MeshSettings,
    PhotoSettings,
    ScaleSettings,
    SceneSettings,
    Section,
    TextureSettings,
)
from sfm_app.settings.toml_files import MOST_TOML_BYTES

__all__ = [
    "LOCAL_ADDRESS",
    "MOST_TOML_BYTES",
    "QUALITY_PRESETS",
    "CalibrationSettings",
    "ClusterSettings",
    "ConstraintForm",
    "DepthSettings",
    "EpipolarSettings",
    "MatchSettings",
    "MeshSettings",
    "PhotoSettings",
    "ScaleSettings",
    "SceneSettings",
    "Section",
    "Settings",
    "TextureSettings",
    "merge_nested",
]
