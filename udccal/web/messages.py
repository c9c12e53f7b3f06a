"""What windows and server say to each other, as JSON."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict
from typing import Annotated, Any, final

from pydantic import BaseModel, ConfigDict, Field

from udccal.guide.events import Answer, ReadingsEvent
from udccal.web.person import News
from udccal.web.shown import Shown
from udccal.web.view import View

# A window names itself by a random number in hexadecimal digits.
_Window = Annotated[str, Field(pattern=r"^[0-9a-f]{16,64}$")]
_Number = Annotated[int, Field(ge=0, lt=2**53)]


@final
class AskedNews(BaseModel):
    """A window's question for news, from the query of an address; see ``WebPerson.news``."""

    model_config = ConfigDict(extra="forbid")

    window: _Window
    version: _Number
    view: _Number


@final
class PostedAnswer(BaseModel):
    """A window's answer to an open question, from a body of JSON."""

    model_config = ConfigDict(extra="forbid", strict=True)

    window: _Window
    question: _Number
    answer: Answer


def news_json(news: News) -> bytes:
    """Return news as a window reads them; a number that is not finite becomes null."""
    said = {
        "version": news.version,
        "mayAnswer": news.may_answer,
        **_shown(news.shown),
        "view": None if news.view is None else _view(news.view),
    }
    return json.dumps(_finite(said), allow_nan=False).encode()


def _shown(shown: Shown) -> dict[str, Any]:
    readings = shown.readings
    return {**asdict(shown), "readings": None if readings is None else _readings(readings)}


def _readings(event: ReadingsEvent) -> dict[str, Any]:
    return {"sentence": event.sentence, "readings": [asdict(one) for one in event.readings]}


def _view(view: View) -> dict[str, Any]:
    return {
        "number": view.number,
        "region": asdict(view.region),
        "jpeg": base64.b64encode(view.picture.jpeg).decode("ascii"),
        "histogram": view.picture.histogram.tolist(),
        "clipped": view.picture.clipped,
        "outlines": [asdict(outline) for outline in view.outlines],
    }


def _finite(value: Any) -> Any:
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: _finite(one) for name, one in value.items()}
        case list() | tuple():
            return [_finite(one) for one in value]
    return value
