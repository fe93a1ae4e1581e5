"""Calibration boards: where their points are, and finding them in an image.

A board's points lie in a grid of ``columns`` x ``rows``, row by row. For ``checker`` and
``charuco`` they are the inner corners. ``circles-asymmetric`` is OpenCV's: every other row is
shifted, point (i, j) lies at ((2 j + i % 2) s, i s).

The grid's labels may come out turned by 180 degrees, from pose to pose: `calibrate` does not mind,
since camera and projector get theirs from the same label. They are never mirrored.
"""

from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.style import figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("checker", "circles", "circles-asymmetric", "charuco")
SUBPIX_SHARE = 0.17
"""Half the window of a checker's corner, in squares: its edges are straight there, and enough
pixels see them."""
FEWEST_CORNERS = 8
"""Of a charuco board, of which a part may be out of sight."""
FEWEST_MARKERS = 4
"""Of a dictionary, to name it: noise looks like a marker or two."""
SEEDS = (0.75, 0.5, 0.0)
"""Sides of the part that is looked for, and grown from, where a checker is not found: shares of its
own; at least 3."""
SEED_IMAGE_PX = 800
"""Longer side of the image for this: of a board that fills it, a square keeps 30 px and more."""
DICTIONARIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36H11",
    "DICT_ARUCO_MIP_36H12",
)
"""Those that hold all markers which boards are printed with: the smaller ones are their
beginnings."""
SHEET_MARGIN = 2
"""Spacings from the outermost points to the edge of a printed sheet: the squares of a checker reach
one spacing beyond its inner corners, and finders need white around them."""
MM_PER_INCH = 25.4
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
"""Where OpenCV's search for a corner stops: after 100 steps, or at a step below 1e-5 px, far below
the error of a corner."""


@dataclass(frozen=True)
class Board:
    """``columns`` x ``rows`` points ``spacing_mm`` apart. ``detail_mm``: the circles' radius (0:
    not known, their bias is not corrected) or the side of charuco's markers; ``dictionary``: the
    markers', by OpenCV's name. Raises `CalibrationError` for an unknown kind and impossible
    numbers."""

    kind: str
    columns: int
    rows: int
    spacing_mm: float
    detail_mm: float = 0.0
    dictionary: str = "DICT_4X4_1000"

    def __post_init__(self) -> None:
        wrong = None
        if self.kind not in KINDS:
            wrong = f"kind: expected one of {', '.join(KINDS)}, got {self.kind!r}"
        elif min(self.columns, self.rows) < 3:
            wrong = f"expected at least 3 x 3 points, got {self.columns} x {self.rows}"
        elif not 0 < self.spacing_mm < np.inf:
            wrong = f"spacing_mm: expected a positive number of mm, got {self.spacing_mm!r}"
        elif not 0 <= self.detail_mm < self.spacing_mm:
            wrong = (
                f"radius or marker: expected mm below the spacing of {self.spacing_mm:g} mm, got "
                f"{self.detail_mm!r}"
            )
        elif self.kind == "charuco" and (
            not self.detail_mm or not hasattr(cv2.aruco, self.dictionary)
        ):
            got = f"{self.detail_mm:g} mm and {self.dictionary}"
            wrong = (
                f"charuco needs its markers' side in mm and the name of an OpenCV dictionary, got "
                f"{got}"
            )
        if wrong:
            raise CalibrationError(f"board: {wrong}")

    def __str__(self) -> str:
        return f"{self.kind}:{self.columns}x{self.rows}:{self.spacing_mm:g}"

    @property
    def radius_mm(self) -> float:
        """Radius of the circles, 0 for other boards or where it is not known."""
        return self.detail_mm if self.kind.startswith("circles") else 0.0

    def points_mm(self) -> NDArray[np.float64]:
        """The points on the board, (n, 3) float64 in mm; z is 0."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        if self.kind == "circles-asymmetric":
            column = 2 * column + row % 2
        return np.stack([column, row, np.zeros_like(row)], axis=1) * float(self.spacing_mm)

    def find(self, image: NDArray[np.uint8], name: str = "image") -> NDArray[np.float64]:
        """Image coordinates (n, 2) float64 px of the points in an 8-bit image (H, W); NaN for
        corners of a charuco board that are out of sight. Of a circle it is the centroid of its
        image, which is not the image of its centre. Raises `CalibrationError` with ``name`` and
        what was seen where the board is not found."""
        if image.ndim != 2 or image.dtype != np.uint8:
            raise CalibrationError(
                f"{name}: expected an 8-bit grey image, got {image.dtype} of shape {image.shape}"
            )
        low, high = np.percentile(image, [1, 99.5])
        stretched = np.clip((image - low) * (255 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
        find = {"checker": self._corners, "charuco": self._charuco}.get(self.kind, self._circles)
        corners = find(image, stretched)
        if corners is None:
            part = "" if self.kind != "charuco" else f" (at least {FEWEST_CORNERS} of its corners)"
            seen, places = {"checker": self._part, "charuco": self._markers}.get(
                self.kind, self._blobs
            )(stretched)
            if len(places):
                (left, top), (right, bottom) = places.min(axis=0), places.max(axis=0)
                seen += f", in columns {left:.0f} to {right:.0f} and rows {top:.0f} to {bottom:.0f}"
            raise CalibrationError(
                f"{name}: the board {self} was not found{part}; expected {self.columns} x "
                f"{self.rows} "
                f"{'circles' if self.kind.startswith('circles') else 'inner corners'}, in focus, "
                f"lit, and with a "
                f"margin around them; seen: {seen}; the image has grey levels {low:.0f} to "
                f"{high:.0f}. Look at it, and "
                "give the board's numbers of points, columns first"
            )
        return self._right_handed(corners.reshape(-1, 2).astype(np.float64))

    def _right_handed(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """The grids with a mirror plane, which a finder may label from either side, labelled x
        right, y down."""
        if self.kind in ("checker", "circles"):
            grid = corners.reshape(self.rows, self.columns, 2)
            across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
            if across[0] * down[1] - across[1] * down[0] < 0:
                return np.ascontiguousarray(grid[:, ::-1]).reshape(-1, 2)
        return corners

    def _corners(self, image: NDArray[np.uint8], stretched: NDArray[np.uint8]) -> NDArray | None:
        size = (self.columns, self.rows)
        accurate = cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_ACCURACY
        for flags in (accurate, accurate + cv2.CALIB_CB_EXHAUSTIVE):
            detected, corners = cv2.findChessboardCornersSB(stretched, size, flags=flags)
            if detected:
                return _refined(image, corners)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
        detected, corners = cv2.findChessboardCorners(stretched, size, flags=flags)
        return _refined(image, corners) if detected else None

    def _part(self, stretched: NDArray[np.uint8]) -> tuple[str, NDArray[np.float64]]:
        """The largest part of a checker that is seen, in words, and its corners (n, 2) px."""
        scale = min(1.0, SEED_IMAGE_PX / max(stretched.shape))
        image = cv2.resize(stretched, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_EXHAUSTIVE + cv2.CALIB_CB_LARGER
        for share in SEEDS:
            seed = [max(3, int(np.ceil(share * count))) for count in (self.columns, self.rows)]
            detected, corners, grid = cv2.findChessboardCornersSBWithMeta(image, seed, flags)
            if detected:
                columns, rows = sorted(
                    grid.shape, reverse=self.columns > self.rows
                )  # OpenCV may have turned it
                return f"{grid.size} corners of a checker ({columns} x {rows})", (
                    corners.reshape(-1, 2) + 0.5
                ).astype(np.float64) / scale - 0.5
        return "no corners of a checker", np.empty((0, 2))

    def _blob_detector(self, pixels: int) -> Any:
        settings: Any = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
        settings.minArea, settings.maxArea = 12.0, pixels / (self.columns * self.rows)
        settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 50, 220, 10
        settings.minDistBetweenBlobs, settings.filterByConvexity, settings.minInertiaRatio = (
            4,
            False,
            0.05,
        )
        return cv2.SimpleBlobDetector_create(settings)  # type: ignore[attr-defined]

    def _circles(self, image: NDArray[np.uint8], stretched: NDArray[np.uint8]) -> NDArray | None:
        flags = (
            cv2.CALIB_CB_SYMMETRIC_GRID if self.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
        )
        size, detector = (self.columns, self.rows), self._blob_detector(image.size)
        for picture in (stretched, 255 - stretched):
            for clustering in (0, cv2.CALIB_CB_CLUSTERING):
                detected, centres = cv2.findCirclesGrid(
                    picture, size, flags=flags + clustering, blobDetector=detector
                )
                if detected:
                    return centres
        return None

    def _blobs(self, stretched: NDArray[np.uint8]) -> tuple[str, NDArray[np.float64]]:
        """How many dark or bright dots are seen, in words, and where, (n, 2) px."""
        detector = self._blob_detector(stretched.size)
        dots = max((detector.detect(picture) for picture in (stretched, 255 - stretched)), key=len)
        return f"{len(dots)} dots", np.array([dot.pt for dot in dots]).reshape(-1, 2)

    def _charuco(self, image: NDArray[np.uint8], stretched: NDArray[np.uint8]) -> NDArray | None:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        squares = (self.columns + 1, self.rows + 1)
        corners = np.full((self.columns * self.rows, 2), np.nan)
        most = FEWEST_CORNERS - 1
        for before_4_6 in (
            False,
            True,
        ):  # with an even number of rows, OpenCV's markers lay on the other squares
            board = cv2.aruco.CharucoBoard(squares, self.spacing_mm, self.detail_mm, dictionary)
            board.setLegacyPattern(before_4_6)
            detected_px, labels, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(stretched)
            if labels is not None and len(labels) > most:
                most, corners[:] = len(labels), np.nan
                corners[np.ravel(labels)] = _refined(image, detected_px).reshape(-1, 2)
        return corners if most >= FEWEST_CORNERS else None

    def _markers(self, stretched: NDArray[np.uint8]) -> tuple[str, NDArray[np.float64]]:
        """The markers that are seen, of the dictionary with the most of them, in words, and their
        corners (n, 2) px."""
        mirrored = f"{self.dictionary} in the mirrored image"
        markers = {}
        for name in (self.dictionary, mirrored, *DICTIONARIES):
            dictionary = getattr(cv2.aruco, name.split()[0])
            detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))
            markers[name] = detector.detectMarkers(
                stretched[:, ::-1].copy() if name == mirrored else stretched
            )
        most = max(markers, key=lambda name: len(markers[name][0]))
        name = most if len(markers[most][0]) >= FEWEST_MARKERS else self.dictionary
        corners, numbers, _ = markers[name]
        if not corners:
            return f"no markers of {name}", np.empty((0, 2))
        board_has = (self.columns + 1) * (self.rows + 1) // 2
        seen = (
            f"{len(corners)} markers of {name}, numbered {numbers.min()} to {numbers.max()} (the "
            f"board has {board_has}"
        )
        seen += ")" if name == self.dictionary else f" of {self.dictionary})"
        return seen, np.concatenate(corners).reshape(-1, 2).astype(np.float64)


def _refined(image: NDArray[np.uint8], corners: NDArray) -> NDArray:
    """Corners at the saddle points of the grey levels: on drawn boards nearer to the truth than the
    finders' own."""
    corners = corners.reshape(-1, 1, 2).astype(np.float32)
    half = int(np.clip(SUBPIX_SHARE * nearest_px(corners[:, 0]).min(), 3, 15))
    return cv2.cornerSubPix(image.astype(np.float32), corners, (half, half), (-1, -1), _STOP)


def nearest_px(corners: NDArray) -> NDArray[np.float64]:
    """Distance (n,) in px of each corner (n, 2) to its nearest neighbour; NaN for corners that are
    NaN."""
    distances = np.hypot(*(corners[:, None] - corners[None]).astype(np.float64).transpose(2, 0, 1))
    np.fill_diagonal(distances, np.inf)
    nearest = np.min(np.where(np.isnan(distances), np.inf, distances), axis=1)
    return np.where(np.isnan(corners[:, 0]), np.nan, nearest)


def parse_board(text: str) -> Board:
    """The board that ``text`` names: ``KIND:COLUMNSxROWS:SPACING[:DETAIL[:DICTIONARY]]`` in mm,
    such as ``checker:9x13:10``, ``circles:5x9:20:6`` (radius 6 mm),
    ``charuco:7x10:20:15:DICT_5X5_100`` (markers of 15 mm). Raises `CalibrationError`."""
    kind, *rest = text.strip().split(":")
    try:
        columns, rows = (int(count) for count in rest[0].lower().split("x"))
        spacing, detail, dictionary, *more = [
            *rest[1:],
            *("", "0", Board.dictionary)[len(rest) - 1 :],
        ]
        if more:
            raise ValueError
        spacing_mm, detail_mm = float(spacing), float(detail)
    except (ValueError, IndexError):
        raise CalibrationError(
            "board: expected KIND:COLUMNSxROWS:SPACING in mm, such as checker:9x13:10, or "
            "circles:5x9:20:6 for circles "
            f"with a radius of 6 mm, got {text!r}"
        ) from None
    return Board(kind, columns, rows, spacing_mm, detail_mm, dictionary)


@styled
def draw_board(board: Board) -> "Figure":
    """A sheet to print at its true size, with a white margin: a figure of the sheet's size. Raises
    `CalibrationError` for circles whose radius is not given, or with which they touch."""
    from matplotlib.patches import Circle, Rectangle

    circles, spacing = board.kind.startswith("circles"), board.spacing_mm
    if circles and not 0 < board.radius_mm < spacing / 2:
        raise CalibrationError(
            f"board {board}: to print it, give the circles' radius in mm, below half of their "
            f"spacing, as in circles:5x9:20:6; got {board.radius_mm:g}"
        )
    points_mm = board.points_mm()[:, :2]
    (left, top), (right, bottom) = (
        points_mm.min(axis=0) - SHEET_MARGIN * spacing,
        points_mm.max(axis=0) + SHEET_MARGIN * spacing,
    )
    sheet = figure((right - left) / MM_PER_INCH, (bottom - top) / MM_PER_INCH, layout=None)
    axes = sheet.add_axes((0, 0, 1, 1), xlim=(left, right), ylim=(bottom, top))
    axes.set_axis_off()
    if circles:
        for centre in points_mm:
            axes.add_patch(Circle(centre, board.radius_mm, color="black", linewidth=0))
        return sheet
    for row in range(board.rows + 1):
        for column in range(row % 2, board.columns + 1, 2):
            corner = (spacing * (column - 1), spacing * (row - 1))
            axes.add_patch(Rectangle(corner, spacing, spacing, color="black", linewidth=0))
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        squares = (board.columns + 1, board.rows + 1)
        markers = cv2.aruco.CharucoBoard(squares, spacing, board.detail_mm, dictionary)
        cells = dictionary.markerSize + 2  # with the black border
        corners_mm = np.array(markers.getObjPoints())[..., :2] - spacing
        for number, corners in zip(np.ravel(markers.getIds()), corners_mm, strict=True):
            image = cv2.aruco.generateImageMarker(dictionary, int(number), cells)
            (x0, y0), (x1, y1) = corners[0], corners[2]
            axes.imshow(image, "gray", extent=(x0, x1, y1, y0), interpolation="none", aspect="auto")
        axes.set(xlim=(left, right), ylim=(bottom, top))
    return sheet


def board_pdf(board: Board) -> bytes:
    """`draw_board` as PDF: the same bytes each time."""
    content = BytesIO()
    draw_board(board).savefig(content, format="pdf", metadata={"CreationDate": None})
    return content.getvalue()
