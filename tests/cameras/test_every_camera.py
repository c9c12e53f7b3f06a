"""What holds for every camera behind the protocol, whatever stands behind it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.cameras.backends import BACKENDS, NAN, Backend
from udccal.cameras.pixel_formats import PIXEL_FORMATS
from udccal.cameras.protocol import Camera, Counts, Frame, Mode, Region, Trigger
from udccal.errors import CameraError

SENTENCE = r"Expected .*, found .*\. [A-Z].*\."
LONGEST_WAIT_S = 5.0


@pytest.fixture(params=BACKENDS.values(), ids=BACKENDS.keys())
def backend(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Backend:
    return request.param(tmp_path, lambda: request.getfixturevalue("shared_data"), monkeypatch)


@pytest.fixture
def camera(backend: Backend) -> Iterator[Camera]:
    with backend.camera() as camera:
        yield camera


def taken(camera: Camera, backend: Backend, count: int) -> list[Frame]:
    camera.configure(backend.settings)
    return list(camera.frames(count))


def test_says_who_it_is_whether_open_or_not(backend: Backend) -> None:
    camera = backend.camera()
    # Asking the instance would ask a closed camera for its features (typing.Protocol before Python 3.12).
    members = {name for name in vars(Camera) if not name.startswith("_")} | {"__enter__", "__exit__"}
    assert len(members) == 12
    assert all(hasattr(type(camera), name) for name in members)
    before = camera.identity
    assert all((before.vendor, before.model, before.serial, before.backend))
    with camera:
        assert camera.identity == before
    assert camera.identity == backend.camera().identity == before


def test_does_nothing_while_closed(backend: Backend) -> None:
    camera = backend.camera()
    with camera:
        mode = camera.mode
    for use in (lambda: camera.frames(1), lambda: camera.configure(backend.settings), lambda: camera.set_mode(mode)):
        with pytest.raises(CameraError, match="open camera, found it closed"):
            use()


def test_says_what_it_can_do(camera: Camera) -> None:
    features, sensor = camera.features, camera.sensor
    for bounds in (features.exposure_s, features.gain_dB, features.frame_rate_hz):
        assert bounds.low <= bounds.high
    assert 0 < features.exposure_s.low <= features.exposure_s.high < 1e5
    assert features.frame_rate_hz.low >= 0
    assert len(set(features.pixel_formats)) == len(features.pixel_formats) > 0
    assert Trigger.FREE_RUN in features.triggers
    assert all(step >= 2 and step % 2 == 0 for step in features.region_steps)
    assert (sensor.x, sensor.y, sensor.columns % 2, sensor.rows % 2) == (0, 0, 0, 0)
    assert min(sensor.columns, sensor.rows) > 0


def test_starts_in_a_mode_of_its_own(camera: Camera) -> None:
    assert camera.mode.pixel_format in camera.features.pixel_formats
    assert camera.mode.trigger in camera.features.triggers
    assert camera.cfa in ("RGGB", "GRBG", "GBRG", "BGGR", "mono")
    assert 1 <= camera.bits <= 16


def test_takes_every_mode_that_it_offers(camera: Camera) -> None:
    for name in camera.features.pixel_formats:
        accepted = camera.set_mode(Mode(name))
        assert accepted == camera.mode
        assert (accepted.pixel_format, accepted.trigger) == (name, Trigger.FREE_RUN)
        if name in PIXEL_FORMATS:
            assert (camera.cfa, camera.bits) == (PIXEL_FORMATS[name].cfa, PIXEL_FORMATS[name].bits)
    for trigger in camera.features.triggers:
        assert camera.set_mode(Mode(camera.mode.pixel_format, trigger=trigger)).trigger is trigger
        assert camera.mode.trigger is trigger


def test_takes_a_frame_rate_where_it_has_one(camera: Camera) -> None:
    bounds, mode = camera.features.frame_rate_hz, camera.mode
    if bounds.high > 0:
        accepted = camera.set_mode(replace(mode, frame_rate_hz=bounds.high / 4))
        assert accepted.frame_rate_hz == pytest.approx(bounds.high / 4, rel=0.01)
        assert camera.mode == accepted
        assert camera.set_mode(replace(mode, frame_rate_hz=None)).frame_rate_hz is None
    for rate_hz in (NAN, -1.0, 1e9):
        with pytest.raises(CameraError, match=SENTENCE):
            camera.set_mode(replace(mode, frame_rate_hz=rate_hz))


def test_refuses_a_mode_that_it_does_not_offer(camera: Camera) -> None:
    mode = camera.mode
    for name in ("", "RGB8", "Mono12 ", "X" * 10_000):
        with pytest.raises(CameraError, match=SENTENCE) as caught:
            camera.set_mode(replace(mode, pixel_format=name))
        assert len(str(caught.value)) < 1000
    for trigger in set(Trigger) - set(camera.features.triggers):
        with pytest.raises(CameraError, match=SENTENCE):
            camera.set_mode(replace(mode, trigger=trigger))
    assert camera.mode == mode


def test_says_which_settings_it_accepted(camera: Camera, backend: Backend) -> None:
    accepted = camera.configure(backend.settings)
    assert accepted.region == backend.accepted.region
    assert accepted.exposure_s == pytest.approx(backend.accepted.exposure_s, rel=1e-3)
    assert accepted.gain_dB == pytest.approx(backend.accepted.gain_dB, abs=0.05)
    assert camera.configure(accepted) == accepted


def test_frames_say_a_temperature_or_none(camera: Camera, backend: Backend) -> None:
    (frame,) = taken(camera, backend, 1)
    assert frame.temperature_C is None or -50 < frame.temperature_C < 150


def test_takes_the_whole_sensor(camera: Camera, backend: Backend) -> None:
    region = camera.configure(replace(backend.settings, region=camera.sensor)).region
    assert region == camera.sensor


def test_refuses_settings_that_it_cannot_do_and_keeps_its_own(camera: Camera, backend: Backend) -> None:
    accepted = camera.configure(backend.settings)
    another = replace(accepted, region=Region(8, 4, 16, 8))
    for settings in (*backend.refused, replace(another, gain_dB=NAN), replace(another, exposure_s=-1.0)):
        with pytest.raises(CameraError, match=SENTENCE):
            camera.configure(settings)
    (frame,) = camera.frames(1)
    assert frame.settings == accepted


def test_frames_are_whole_and_say_how_they_were_taken(camera: Camera, backend: Backend) -> None:
    accepted = camera.configure(backend.settings)
    frames = list(camera.frames(5))
    assert len(frames) == 5
    for frame in frames:
        assert frame.data.shape == (accepted.region.rows, accepted.region.columns)
        assert frame.data.dtype == np.uint16
        assert 0 < int(frame.data.max()) < 1 << camera.bits
        assert frame.settings == accepted
        assert frame.complete
    assert (np.diff([frame.frame_id for frame in frames]) > 0).all()
    assert (np.diff([frame.timestamp_s for frame in frames]) >= 0).all()
    assert np.isfinite([frame.timestamp_s for frame in frames]).all()


def test_frames_are_the_callers_own(camera: Camera, backend: Backend) -> None:
    frames = taken(camera, backend, 4)
    kept = [frame.data.copy() for frame in frames]
    for index, frame in enumerate(frames):
        frame.data[:] = index
        assert all((later.data == was).all() for later, was in zip(frames[index + 1 :], kept[index + 1 :], strict=True))
    for before in frames:
        assert not any(np.shares_memory(before.data, after.data) for after in frames if after is not before)


def test_a_region_is_a_part_of_the_picture(camera: Camera, backend: Backend) -> None:
    if not backend.still:
        pytest.skip("noise differs from frame to frame")
    outer = taken(camera, backend, 1)[0].data
    region = backend.settings.region
    inner = Region(region.x + 4, region.y + 2, 16, 8)
    camera.configure(replace(backend.settings, region=inner))
    np.testing.assert_array_equal(next(camera.frames(1)).data, outer[2:10, 4:20])


def test_frame_ids_go_on_from_call_to_call(camera: Camera, backend: Backend) -> None:
    camera.configure(backend.settings)
    ids = [frame.frame_id for _ in range(3) for frame in camera.frames(2)]
    assert (np.diff(ids) > 0).all()


def test_counts_begin_anew_when_opened(backend: Backend) -> None:
    camera = backend.camera()
    for _ in range(2):
        with camera:
            assert camera.counts == Counts()
            taken(camera, backend, 3)
            assert camera.counts == Counts(delivered=3)
            taken(camera, backend, 2)
            assert camera.counts == Counts(delivered=5)
        assert camera.counts == Counts(delivered=5)


def test_no_frames_are_no_trouble(camera: Camera, backend: Backend) -> None:
    assert taken(camera, backend, 0) == []
    assert len(taken(camera, backend, 1)) == 1


def test_exposes_when_asked_where_it_has_a_software_trigger(camera: Camera, backend: Backend) -> None:
    if Trigger.SOFTWARE not in camera.features.triggers:
        pytest.skip("no software trigger")
    camera.set_mode(replace(camera.mode, trigger=Trigger.SOFTWARE))
    frames = taken(camera, backend, 3)
    assert [frame.complete for frame in frames] == [True] * 3
    assert (np.diff([frame.frame_id for frame in frames]) == 1).all()


def test_closed_in_the_middle_it_says_so(backend: Backend) -> None:
    camera = backend.camera()
    with camera:
        camera.configure(backend.settings)
        stream = camera.frames(5)
        next(stream)
    with pytest.raises(CameraError, match=SENTENCE):
        next(stream)
    with camera:
        assert len(taken(camera, backend, 2)) == 2


def test_another_stream_ends_the_one_before(camera: Camera, backend: Backend) -> None:
    camera.configure(backend.settings)
    first = camera.frames(3)
    next(first)
    second = camera.frames(3)
    next(second)
    with pytest.raises(CameraError, match=SENTENCE):
        next(first)
    del first
    assert len(list(second)) == 2


@pytest.mark.parametrize("what", ["settings", "mode"])
def test_a_change_ends_the_stream_before(camera: Camera, backend: Backend, what: str) -> None:
    camera.configure(backend.settings)
    stream = camera.frames(3)
    next(stream)
    if what == "settings":
        camera.configure(backend.settings)
    else:
        camera.set_mode(camera.mode)
    with pytest.raises(CameraError, match=SENTENCE):
        next(stream)
    assert len(taken(camera, backend, 2)) == 2


def test_a_stream_may_be_left_early(camera: Camera, backend: Backend) -> None:
    camera.configure(backend.settings)
    for _ in camera.frames(3):
        break
    assert len(taken(camera, backend, 2)) == 2


def test_an_error_in_the_middle_closes_it(backend: Backend) -> None:
    camera = backend.camera()

    def fail_in_the_middle() -> None:
        with camera:
            camera.configure(backend.settings)
            for _ in camera.frames(5):
                raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_in_the_middle()
    with pytest.raises(CameraError, match="open camera"):
        camera.frames(1)
    with camera:
        assert len(taken(camera, backend, 2)) == 2


def test_frames_that_cannot_come_end_in_time(backend: Backend) -> None:
    began = time.monotonic()
    with backend.starving() as camera:
        if backend.starving_mode is not None:
            camera.set_mode(backend.starving_mode)
        camera.configure(backend.settings)
        with pytest.raises(CameraError, match=SENTENCE):
            list(camera.frames(9))
        assert camera.counts.delivered < 9
    assert time.monotonic() - began < LONGEST_WAIT_S
