"""A picture of a profile never has the name of an array that a term may need a file for."""

from __future__ import annotations

from dataclasses import fields
from typing import get_args

import pytest

from udccal.models.backscatter import Backscatter
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.profiles.schema import StoredPicture


@pytest.mark.parametrize(("term", "kind"), [("wire", Wire), ("psf", PsfField), ("backscatter", Backscatter)])
def test_pictures_and_arrays_have_different_names(term: str, kind: type) -> None:
    pictures = set(get_args(StoredPicture.model_fields["name"].annotation))
    assert pictures
    assert not pictures & {f"{term}_{field.name}" for field in fields(kind)}
