"""The formats by name."""

from __future__ import annotations

from collections.abc import Mapping

from udccal.profiles.exchange import estimates_csv, mrcal, npz, opencv_yaml, ros_camera_info
from udccal.profiles.exchange.format import ExportFormat, ImportFormat

EXPORTS: Mapping[str, ExportFormat] = {
    module.EXPORT.name: module.EXPORT for module in (opencv_yaml, ros_camera_info, mrcal, npz, estimates_csv)
}
IMPORTS: Mapping[str, ImportFormat] = {
    module.IMPORT.name: module.IMPORT for module in (opencv_yaml, ros_camera_info, mrcal)
}
