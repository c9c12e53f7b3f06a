"""How much a check captures: the rig's description with few captures, which its procedures then carry out."""

from __future__ import annotations

from udccal.rig import RigDescription

# Ten flats tell a movement of some micrometres; two pictures beside white tell where on the panel the camera is.
_FEW = {"flats": 10, "backscatter_pictures": 2, "backscatter_frames": 4}


def short_rig(rig: RigDescription) -> RigDescription:
    """Return the description of the same rig with the captures of a check."""
    return rig.model_copy(update={"captures": rig.captures.model_copy(update=_FEW)})
