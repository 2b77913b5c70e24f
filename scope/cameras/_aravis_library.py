"""The functions of the system's libaravis-0.8 that the driver calls, by ctypes: nothing of Aravis is part of SCOPE.

Aravis is under the LGPL; https://aravisproject.github.io/aravis (API reference of 0.8).
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from ctypes.util import find_library
from functools import cache
from typing import Any

from scope.errors import CameraError, MissingLibraryError

SUCCESS = 0  # ArvBufferStatus
STATUS = {
    1: "cleared",
    2: "timeout",
    3: "missing packets",
    4: "wrong packet",
    5: "size mismatch",
    6: "half filled",
    7: "aborted",
}


class _Error(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


_ERROR = POINTER(POINTER(_Error))
# name: (result, arguments); those whose last argument is _ERROR are called through `call`
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_model": (c_char_p, [c_uint]),
    "arv_get_device_vendor": (c_char_p, [c_uint]),
    "arv_camera_new": (c_void_p, [c_char_p, _ERROR]),
    "arv_camera_get_model_name": (c_char_p, [c_void_p, _ERROR]),
    "arv_camera_get_region": (None, [c_void_p, POINTER(c_int), POINTER(c_int), POINTER(c_int), POINTER(c_int), _ERROR]),
    "arv_camera_get_exposure_time": (c_double, [c_void_p, _ERROR]),
    "arv_camera_set_exposure_time": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_gain": (c_double, [c_void_p, _ERROR]),
    "arv_camera_set_gain": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_frame_rate": (c_double, [c_void_p, _ERROR]),
    "arv_camera_set_frame_rate": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_pixel_format_as_string": (c_char_p, [c_void_p, _ERROR]),
    "arv_camera_set_pixel_format_from_string": (None, [c_void_p, c_char_p, _ERROR]),
    "arv_camera_set_trigger": (None, [c_void_p, c_char_p, _ERROR]),
    "arv_camera_set_acquisition_mode": (None, [c_void_p, c_int, _ERROR]),
    "arv_camera_set_string": (None, [c_void_p, c_char_p, c_char_p, _ERROR]),
    "arv_camera_set_boolean": (None, [c_void_p, c_char_p, c_bool, _ERROR]),
    "arv_camera_get_payload": (c_uint, [c_void_p, _ERROR]),
    "arv_camera_create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p, _ERROR]),
    "arv_camera_start_acquisition": (None, [c_void_p, _ERROR]),
    "arv_camera_stop_acquisition": (None, [c_void_p, _ERROR]),
    "arv_buffer_new": (c_void_p, [c_size_t, c_void_p]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "arv_buffer_get_image_pixel_format": (c_uint32, [c_void_p]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
}


class Library:
    """Typed access: ``library.arv_...`` for functions without errors, `call` for those that tell one."""

    def __init__(self, aravis: Any, gobject: Any, glib: Any) -> None:
        self._aravis, self._gobject, self._glib = aravis, gobject, glib
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(aravis, name)
            function.restype, function.argtypes = result, arguments
        gobject.g_object_unref.argtypes, gobject.g_object_unref.restype = [c_void_p], None
        glib.g_error_free.argtypes, glib.g_error_free.restype = [c_void_p], None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._aravis, name)

    def call(self, whose: str, name: str, *arguments: Any) -> Any:
        """Call a function that tells errors; `CameraError` with what it says, led by ``whose``."""
        error = POINTER(_Error)()
        result = getattr(self._aravis, name)(*arguments, byref(error))
        if bool(error):  # NULL where all went well
            told = (error.contents.message or b"").decode("utf-8", "replace")
            self._glib.g_error_free(error)
            raise CameraError(f"{whose}: {' '.join(told.split())[:160]} ({name.removeprefix('arv_camera_')})")
        return result

    def release(self, thing: int | None) -> None:
        """Drop one reference of a GObject."""
        if thing:
            self._gobject.g_object_unref(thing)


@cache
def aravis() -> Library:
    """Load the library once; `MissingLibraryError` says how to install it."""
    name = find_library("aravis-0.8") or "libaravis-0.8.so.0"
    try:
        return Library(
            ctypes.CDLL(name),
            ctypes.CDLL(find_library("gobject-2.0") or "libgobject-2.0.so.0"),
            ctypes.CDLL(find_library("glib-2.0") or "libglib-2.0.so.0"),
        )
    except (OSError, AttributeError) as error:
        raise MissingLibraryError(
            f"the system library Aravis 0.8 does not load ({' '.join(str(error).split())[:80]}); run: apt-get install "
            "libaravis-0.8-0 (Debian, Ubuntu), brew install aravis (macOS)"
        ) from error
