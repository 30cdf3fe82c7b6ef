"""A measured lens in a YAML file, which the settings name as `camera.intrinsics`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import yaml
from msgspec import Meta

from vad.config import CameraSettings
from vad.errors import ConfigError
from vad.geometry import Intrinsics

_Size = Annotated[int, Meta(ge=16, le=20_000)]
_Focal = Annotated[float, Meta(gt=1.0, lt=1e6)]
_Term = Annotated[float, Meta(ge=-10.0, le=10.0)]


class LensFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file. k1, k2: radial terms of r' = r (1 + k1 r^2 + k2 r^4); pixels are counted from the middle of
    the first one. focal_sigma_px, error_px, pictures: how well it was measured, from how many pictures."""

    schema: Literal["vad.lens/1"] = "vad.lens/1"
    width_px: _Size
    height_px: _Size
    fx_px: _Focal
    fy_px: _Focal
    cx_px: float
    cy_px: float
    k1: _Term = 0.0
    k2: _Term = 0.0
    focal_sigma_px: float | None = None
    error_px: float | None = None
    pictures: int | None = None

    @property
    def lens(self) -> Intrinsics:
        """The lens itself."""
        return Intrinsics(
            self.width_px, self.height_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.k1, self.k2
        )


def camera_lens(settings: CameraSettings, base: Path) -> Intrinsics | None:
    """The measured lens that the settings name, if any; relative paths are taken from `base`.

    Raises:
        ConfigError: the file is none of a lens.
    """
    return None if settings.intrinsics is None else read_lens(base / settings.intrinsics)


def read_lens(path: Path) -> Intrinsics:
    """The lens of a file.

    Raises:
        ConfigError: it cannot be read, or is no lens.
    """
    remedy = "`vad camera intrinsics` writes such a file"
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        return msgspec.convert(raw, type=LensFile, strict=False).lens
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=str(path), remedy=remedy) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError("not YAML", where=str(path), remedy=remedy) from error
    except msgspec.ValidationError as error:
        raise ConfigError(str(error), where=str(path), remedy=remedy) from error


def write_lens(path: Path, lens: LensFile) -> None:
    """Write the file, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    draft = path.with_name(path.name + ".new")
    draft.write_text(yaml.safe_dump(msgspec.to_builtins(lens), sort_keys=False), encoding="utf-8")
    draft.replace(path)
