"""Boards: drawn through a known homography and found again, and what is refused."""

from io import BytesIO

import cv2
import numpy as np
import pytest

from fpp_ml_bench.calibration.boards import Board, board_pdf, draw_board, parse_board
from fpp_ml_bench.errors import CalibrationError

TO_IMAGE = np.array([[3.0, 0.35, 90.0], [-0.25, 2.8, 110.0], [0.0009, 0.0011, 1.0]])
"""From mm on the board to px."""
SIZE, FINE = (330, 300), 6


def _drawn(board):
    """The board as a camera sees it: averaged over sub-pixels, blurred, with noise and uneven
    light; 8 bits."""
    width, height = SIZE
    y, x = (np.mgrid[0 : height * FINE, 0 : width * FINE] + 0.5) / FINE - 0.5
    flat = np.linalg.inv(TO_IMAGE) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    place = (flat[:2] / flat[2]).reshape(2, *x.shape) / board.spacing_mm
    if board.kind == "checker":
        cells = np.floor(place).astype(int)
        inside = (place > -1).all(0) & (place[0] < board.columns) & (place[1] < board.rows)
        dark = inside & ((cells[0] + cells[1]) % 2 == 0)
    else:
        centres = board.points_mm()[:, :2] / board.spacing_mm
        radius = board.radius_mm / board.spacing_mm
        dark = np.any(
            [np.hypot(*(place - centre[:, None, None])) < radius for centre in centres], axis=0
        )
    light = np.linspace(1, 0.7, width)
    grey = 30 + 120 * (1 - dark).reshape(height, FINE, width, FINE).mean((1, 3)) * light
    noise = np.random.default_rng(1).normal(0, 1, grey.shape)
    return np.clip(np.rint(cv2.GaussianBlur(grey, (0, 0), 0.8) + noise), 0, 255).astype(np.uint8)


def _images_of(points):
    image = TO_IMAGE @ np.stack([points[:, 0], points[:, 1], np.ones(len(points))])
    return (image[:2] / image[2]).T


def _centroids_of(board):
    """Centroids of the images of circles: centres of ellipses, from the dual conic of each
    circle."""
    centres = []
    for x, y, _ in board.points_mm():
        to_circle = np.array([[board.radius_mm, 0, x], [0, board.radius_mm, y], [0, 0, 1]])
        dual = TO_IMAGE @ to_circle @ np.diag([1.0, 1.0, -1.0]) @ (TO_IMAGE @ to_circle).T
        centres.append(dual[:2, 2] / dual[2, 2])
    return np.array(centres)


@pytest.mark.long
@pytest.mark.parametrize(
    "text, tolerance_px",
    [
        ("checker:7x5:10", 0.06),
        ("circles:7x5:10:2.5", 0.06),
        ("circles-asymmetric:4x7:8:2.5", 0.06),
    ],
)
def test_drawn_boards_are_found(text, tolerance_px):
    board = parse_board(text)
    corners = board.find(_drawn(board))
    expected = _images_of(board.points_mm()) if board.kind == "checker" else _centroids_of(board)
    assert corners.dtype == np.float64 and corners.shape == expected.shape
    turned = expected[::-1]  # a grid may be labelled from its other end
    if np.abs(corners - turned).mean() < np.abs(corners - expected).mean():
        expected = turned
    assert np.sqrt(((corners - expected) ** 2).sum(1).mean()) < tolerance_px


@pytest.mark.long
@pytest.mark.parametrize(
    "text",
    [
        "checker:7x5:10",
        "circles:7x5:10:2.5",
        "circles-asymmetric:4x7:8:2.5",
        "charuco:5x6:10:7:DICT_5X5_50",
    ],
)
def test_the_sheet_to_print_has_the_points_where_the_board_says(text):
    board, px_per_mm = parse_board(text), 6
    content = BytesIO()
    draw_board(board).savefig(content, format="png", dpi=25.4 * px_per_mm)
    image = cv2.imdecode(np.frombuffer(content.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    points_mm = board.points_mm()[:, :2]
    size_mm = np.ptp(points_mm, axis=0) + 4 * board.spacing_mm
    np.testing.assert_allclose(image.shape[::-1], px_per_mm * size_mm, atol=1)
    expected = px_per_mm * (points_mm + 2 * board.spacing_mm) - 0.5
    corners = board.find(image)
    errors = [np.abs(order - expected).max() for order in (corners, corners[::-1])]
    assert min(errors) < 0.3
    assert board_pdf(board) == board_pdf(board) and board_pdf(board).startswith(b"%PDF")


def test_a_sheet_of_circles_needs_their_radius():
    with pytest.raises(CalibrationError, match="give the circles' radius in mm"):
        draw_board(parse_board("circles:5x9:20"))


@pytest.mark.parametrize("hidden", [False, True])
def test_a_charuco_board_is_found_and_may_be_partly_hidden(hidden):
    image, expected = _charuco(5, 6, False)
    if hidden:
        image[:, :120] = 255
    corners = parse_board("charuco:5x6:10:7:DICT_5X5_50").find(image)
    assert np.isnan(corners).any() == hidden and np.nanmax(np.abs(corners - expected)) < 0.1


def _charuco(columns, rows, before_4_6):
    """Squares of 40 px in a margin of 40 px, and where the inner corners are."""
    drawn = cv2.aruco.CharucoBoard(
        (columns + 1, rows + 1), 10.0, 7.0, cv2.aruco.getPredefinedDictionary(MARKERS)
    )
    drawn.setLegacyPattern(before_4_6)
    image = drawn.generateImage((40 * (columns + 1), 40 * (rows + 1)))
    row, column = np.divmod(np.arange(columns * rows), columns)
    border = cv2.copyMakeBorder(image, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    return border, np.stack([column, row], axis=1) * 40 + 79.5


MARKERS = cv2.aruco.DICT_5X5_50


@pytest.mark.parametrize(("rows", "before_4_6"), [(5, True), (4, False), (4, True)])
def test_markers_may_lie_as_before_opencv_4_6(rows, before_4_6):
    image, expected = _charuco(7, rows, before_4_6)
    image[:, 300:] = 255
    corners = parse_board(f"charuco:7x{rows}:10:7:DICT_5X5_50").find(image)
    assert np.isfinite(corners).all(axis=1).sum() >= 8
    assert np.nanmax(np.abs(corners - expected)) < 0.5


@pytest.mark.long
@pytest.mark.parametrize(
    "text, seen_part, seen",
    [
        (
            "checker:7x5:10",
            np.s_[:, :-75],
            r"seen: 30 corners of a checker \(6 x 5\), in columns 90",
        ),
        ("checker:9x5:10", ..., r"seen: 35 corners of a checker \(7 x 5\), in columns 90"),
        (
            "checker:7x5:10",
            np.s_[:90],
            "seen: no corners of a checker; the image has grey levels",
        ),
        ("circles:7x5:10:2.5", np.s_[:, 100:], r"seen: 30 dots, in columns \d+ to \d+ and rows"),
        (
            "charuco:7x5:10:7",
            ...,
            r"24 markers of DICT_5X5_1000, .* has 24 of DICT_4X4_1000\), in col",
        ),
        (
            "charuco:7x5:10:7:DICT_5X5_50",
            np.s_[:, ::-1],
            "24 markers of DICT_5X5_50 in the mirrored",
        ),
        (
            "charuco:8x6:10:7:DICT_5X5_50",
            ...,
            r"24 markers .* numbered 0 to 23 \(the board has 31\)",
        ),
        (
            "charuco:7x5:10:7:DICT_5X5_50",
            np.s_[:60],
            "seen: no markers of DICT_5X5_50; the image has",
        ),
    ],
)
def test_of_a_board_that_is_not_found_it_is_said_what_was_seen(text, seen_part, seen):
    kind, _, spacing, *radius = text.split(":")
    whole = parse_board(":".join((kind, "7x5", spacing, *radius)))
    image = _charuco(7, 5, False)[0] if kind == "charuco" else _drawn(whole)
    with pytest.raises(CalibrationError, match=seen):
        parse_board(text).find(np.ascontiguousarray(image[seen_part]))


@pytest.mark.long
def test_dots_that_are_brighter_than_the_board_are_seen():
    image = _drawn(parse_board("circles:7x5:10:2.5"))
    with pytest.raises(CalibrationError, match="seen: 30 dots, in"):
        parse_board("circles:7x5:10:2.5").find(255 - image[:, 100:])


@pytest.mark.long
def test_labels_are_never_mirrored():
    board = parse_board("checker:7x5:10")
    for image in (_drawn(board), np.ascontiguousarray(_drawn(board)[:, ::-1])):
        grid = board.find(image).reshape(5, 7, 2)
        assert np.linalg.det(np.stack([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]])) > 0


def test_points():
    assert Board("checker", 3, 4, 2.5).points_mm()[[0, 1, 3, -1]].tolist() == [
        [0, 0, 0],
        [2.5, 0, 0],
        [0, 2.5, 0],
        [5, 7.5, 0],
    ]
    assert Board("circles-asymmetric", 3, 4, 2.0).points_mm()[[0, 1, 3]].tolist() == [
        [0, 0, 0],
        [4, 0, 0],
        [2, 2, 0],
    ]


def test_an_absent_board_is_named():
    with pytest.raises(
        CalibrationError,
        match="pose 7: the board checker:9x6:10 was not found; expected 9 x 6 inner",
    ):
        parse_board("checker:9x6:10").find(np.full((120, 160), 90, np.uint8), "pose 7")
    with pytest.raises(CalibrationError, match="8-bit grey image, got float64"):
        parse_board("checker:9x6:10").find(np.zeros((120, 160)))


@pytest.mark.parametrize(
    "text, message",
    [
        ("checker:9x13", "expected KIND:COLUMNSxROWS:SPACING"),
        ("checker:9x13:ten", "expected KIND"),
        ("chess:9x13:10", "expected one of checker"),
        ("checker:2x13:10", "at least 3 x 3 points, got 2 x 13"),
        ("checker:9x13:-1", "positive number of mm"),
        ("checker:9x13:nan", "positive number of mm"),
        ("circles:9x13:10:12", "below the spacing of 10 mm, got 12"),
        ("charuco:9x13:10", "markers' side"),
        ("charuco:9x13:10:7:DICT_9", "dictionary, got 7 mm and DICT_9"),
    ],
)
def test_a_wrong_text_is_refused(text, message):
    with pytest.raises(CalibrationError, match=message):
        parse_board(text)
