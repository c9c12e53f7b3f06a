"""What is printed beside the board, as sentences."""

from __future__ import annotations

from udccal.board.set_up import SetUp


def sentences(rig_name: str, set_up: SetUp) -> tuple[str, ...]:
    """Say what the board is, how it is printed, and where it and the LED stand."""
    board, (x, y, z), (near, far) = set_up.board, set_up.jig_mm, set_up.views_mm
    said = [
        f"Board of the rig {rig_name}: ChArUco, {board.columns} x {board.rows} squares of {board.square_mm:g} mm, "
        f"markers of {board.marker_mm:g} mm, {board.dictionary}.",
        f"Print at 100 % (actual size), never fitted to the page. Then measure: the ruler must be 100.0 mm long, the "
        f"board {set_up.width_mm:.1f} mm wide and {set_up.height_mm:.1f} mm high. If not, correct the printer's scale "
        "and print again.",
        "Glue it on a flat, stiff, matt plate. Leave white paper around it, and cover no square.",
        f"On the jig: parallel to the display and {z:.0f} mm in front of it. As the camera sees it from behind, the "
        f"outer top left corner of the board is {_aside(x, 'right', 'left')} and {_aside(y, 'below', 'above')} the "
        "display's top left pixel.",
        f"By hand: {set_up.views} poses, the middle of the board {near:.0f} to {far:.0f} mm in front of the display.",
    ]
    if set_up.led_mm is not None:
        said.append(
            f"LED: white, {set_up.led_mm:g} mm in diameter, {set_up.led_distance_mm:.0f} mm in front of the display, "
            "in a dark room."
        )
    return tuple(said)


def joining(sheets: int) -> str:
    """Say how several sheets become one board."""
    return (
        f"The board takes {sheets} sheets. Each seam has a mark at both of its ends, outside the picture. Cut a sheet "
        "along the seams to its right and below it, and glue it on its neighbours so that the marks of both meet. "
        "The board as a whole must have the size above, to 0.5 mm."
    )


def _aside(shift_mm: float, positive: str, negative: str) -> str:
    where = positive if shift_mm >= 0 else negative
    return f"{abs(shift_mm):.0f} mm {where}{' of' if where in ('right', 'left') else ''}"
