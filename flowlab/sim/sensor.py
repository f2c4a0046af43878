"""What a depth camera makes of a perfect picture: noise, steps, frayed edges and holes, all by a seed."""

import math
from statistics import NormalDist
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from pydantic import Field

from flowlab.config import Settings

_EMPTY_M = 1e3
"""Stands for the distance of what has none, beyond any range."""


class SensorSettings(Settings):
    """How a structured-light or stereo depth camera errs. The defaults are a Kinect's at 320×240; 0 switches
    an effect off."""

    axial_noise: float = Field(default=0.0015, ge=0)
    """Depth noise [1/m]: its standard deviation is this times z²."""
    axial_correlation_px: float = Field(default=1.0, ge=0)
    """How far neighboring pixels err alike: standard deviation of the Gaussian that smooths the noise."""
    inverse_depth_step: float = Field(default=1 / 348, ge=0)
    """1/z comes in multiples of this [1/m], so depth in steps of about this times z²: a sixteenth of a pixel
    of disparity at a focal length of 290 px and a baseline of 75 mm."""
    edge_smear_px: float = Field(default=0.56, ge=0)
    """How far edges wander to either side [px], as a standard deviation."""
    edge_holes: float = Field(default=0.25, ge=0, le=1)
    """Share of the pixels at depth edges that give no reading."""
    random_holes: float = Field(default=0.003, ge=0, le=1)
    """Share of single pixels anywhere that give no reading."""
    blotch_sigmas: float = Field(default=3.0, ge=0)
    """Blotches without reading are where smooth unit noise exceeds this: at 3, about 1 pixel in 1000."""
    fattened_px: int = Field(default=0, ge=0)
    """Nearer surfaces reach over their edges by so much [px], as matching by windows makes them."""
    plain_holes: float = Field(default=0.0, ge=0, le=1)
    """Share of the surface without texture that gives no reading, in patches."""
    flying_pixels: float = Field(default=0.0, ge=0, le=1)
    """Share of the pixels at depth edges that read some depth between the two surfaces."""
    max_range_m: float = Field(default=6.0, gt=0, lt=_EMPTY_M)
    """Nothing farther is seen."""
    gain_noise: float = Field(default=0.015, ge=0)
    """Flicker: standard deviation of the brightness of a whole color picture, as a share."""
    color_noise: float = Field(default=3.0, ge=0)
    """Standard deviation of every color value, of 255."""
    jpeg_quality: int = Field(default=92, ge=0, le=100)
    """Color pictures are compressed and unpacked at this quality; 0 leaves them alone."""


KINECT = SensorSettings()
CLEAN = SensorSettings(
    axial_noise=0,
    inverse_depth_step=0,
    edge_smear_px=0,
    edge_holes=0,
    random_holes=0,
    blotch_sigmas=0,
    gain_noise=0,
    color_noise=0,
    jpeg_quality=0,
)
"""Sees perfectly, but not beyond its range."""
STEREO = SensorSettings(
    axial_noise=0.003,
    axial_correlation_px=2.5,
    inverse_depth_step=1 / 600,
    fattened_px=2,
    plain_holes=0.3,
    edge_holes=0.1,
    max_range_m=4.0,
)
"""A stereo camera as the D435: noise with z² that neighbors share, fattened edges, holes on plain surfaces."""
TOF = SensorSettings(
    axial_noise=0.001,
    axial_correlation_px=0.0,
    inverse_depth_step=0,
    edge_smear_px=0,
    edge_holes=0.2,
    flying_pixels=0.5,
    max_range_m=5.0,
)
"""A time-of-flight camera as the Azure Kinect: little noise, flying pixels at edges."""
PRESETS = MappingProxyType({"kinect": KINECT, "stereo": STEREO, "tof": TOF, "clean": CLEAN})

_SMEAR_CORRELATION_PX = 1.2
_BLOTCH_CORRELATION_PX = 2.0
_PATCH_CORRELATION_PX = 6.0
_MATCHED_PX = 9
"""Side of the window in which a stereo camera looks for texture."""
_PLAIN_DEVIATION = 2.0
"""Brightness within a window that differs by less, of 255, is none that can be matched."""
_SAME_SURFACE_M = 0.02
"""Where a smeared reading differs by less, there is no edge, and the pixel keeps its own depth."""
_EDGE_SHARE = 0.03
"""A depth edge is where depth within 3×3 pixels differs by more than this share of it."""


class Sensor:
    """A depth camera. Pictures given in the same order to one of the same seed come out the same."""

    def __init__(self, settings: SensorSettings, seed: int) -> None:
        self.settings = settings
        self._rng = np.random.default_rng(seed)

    def depth(
        self, z: Float32[np.ndarray, "H W"], rgb: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> Float32[np.ndarray, "H W"]:
        """What it reads [m] where the true z-depth is ``z`` [m]; 0 where there is nothing, in and out.

        The color picture says where there is no texture to match, for a sensor with ``plain_holes``.
        """
        s = self.settings
        true = np.where(z > 0, z, np.float32(_EMPTY_M)).astype(np.float32)
        read = self._smeared(true) if s.edge_smear_px else true.copy()
        if s.fattened_px:
            read = cv2.erode(read, np.ones((1, 2 * s.fattened_px + 1), np.uint8))  # windows slide along rows
        if s.flying_pixels:
            read = self._flying(true, read)
        if s.axial_noise:
            read += s.axial_noise * read**2 * self._smooth_noise(read.shape, s.axial_correlation_px)
        if s.inverse_depth_step:
            steps = np.round(1 / (np.maximum(read, 0.05) * s.inverse_depth_step))
            read = 1 / np.maximum(steps * s.inverse_depth_step, 1 / _EMPTY_M)
        unseen = (true > s.max_range_m) | (read > s.max_range_m) | self._holes(true)
        if s.plain_holes and rgb is not None:
            unseen |= self._plain_holes(rgb)
        return np.where(unseen, 0, read).astype(np.float32)

    def rgb(self, picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """What it makes of a color picture."""
        s = self.settings
        gain = 1 + s.gain_noise * self._rng.standard_normal()
        noise = s.color_noise * self._rng.standard_normal(picture.shape, np.float32)
        noisy = np.clip(np.rint(picture * np.float32(gain) + noise), 0, 255).astype(np.uint8)
        if not s.jpeg_quality:
            return noisy
        # JPEG blurs color more than brightness, so it matters that OpenCV is told the channels in its order.
        _, packed = cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, s.jpeg_quality])
        unpacked = cv2.imdecode(packed, cv2.IMREAD_COLOR)
        assert unpacked is not None
        return np.ascontiguousarray(unpacked[..., ::-1], np.uint8)

    def _smeared(self, true: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """The picture with its edges shifted to either side; within a surface, every pixel keeps its depth."""
        height, width = true.shape
        du, dv = (self.settings.edge_smear_px * self._smooth_noise(true.shape, _SMEAR_CORRELATION_PX) for _ in "uv")
        v, u = np.mgrid[:height, :width].astype(np.float32)
        shifted = cv2.remap(true, u + du, v + dv, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.where(np.abs(shifted - true) < _SAME_SURFACE_M, true, shifted).astype(np.float32)

    def _flying(self, true: Float32[np.ndarray, "H W"], read: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Pixels that light of two surfaces reaches read something between them."""
        near, far = cv2.erode(true, np.ones((3, 3), np.uint8)), cv2.dilate(true, np.ones((3, 3), np.uint8))
        mixed = (far - near > _EDGE_SHARE * true) & (far < _EMPTY_M)
        mixed &= self._rng.random(true.shape) < self.settings.flying_pixels
        between = near + (far - near) * self._rng.random(true.shape, np.float32)
        return np.where(mixed, between, read).astype(np.float32)

    def _plain_holes(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Bool[np.ndarray, "H W"]:
        """Patches without reading where brightness hardly differs around a pixel."""
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        size = (_MATCHED_PX, _MATCHED_PX)
        variance = cv2.blur(gray**2, size) - cv2.blur(gray, size) ** 2
        patches = self._smooth_noise(gray.shape, _PATCH_CORRELATION_PX)
        return (variance < _PLAIN_DEVIATION**2) & (patches > NormalDist().inv_cdf(1 - self.settings.plain_holes))

    def _holes(self, true: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """Where there is no reading: at edges, here and there, and in blotches."""
        s, chance = self.settings, self._rng.random(true.shape)
        around = np.ones((3, 3), np.uint8)
        edge = cv2.dilate(true, around) - cv2.erode(true, around) > _EDGE_SHARE * true
        holes = chance < np.where(edge, 1 - (1 - s.edge_holes) * (1 - s.random_holes), s.random_holes)
        if s.blotch_sigmas:
            holes |= self._smooth_noise(true.shape, _BLOTCH_CORRELATION_PX) > s.blotch_sigmas
        return holes

    def _smooth_noise(self, shape: tuple[int, ...], correlation_px: float) -> Float32[np.ndarray, "H W"]:
        """Noise of mean 0 and standard deviation 1, smoothed by a Gaussian."""
        white = self._rng.standard_normal(shape, np.float32)
        if not correlation_px:
            return white
        reach = math.ceil(4 * correlation_px)
        kernel = cv2.getGaussianKernel(2 * reach + 1, correlation_px)
        # The border repeats instead of mirroring: a mirrored border would make the noise stronger there.
        padded = np.pad(white, reach, mode="wrap")
        smooth = cv2.sepFilter2D(padded, cv2.CV_32F, kernel, kernel)[reach:-reach, reach:-reach]
        return np.asarray(smooth / (kernel**2).sum(), np.float32)
