"""Users' meshes with colours: linear luminance, interpolation and images against closed forms, and
damaged files."""

import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import load_user_mesh, single_mesh
from fpp_ml_bench.loaders.render.paint import barycentric, bilinear, linear_luminance, texture_of
from fpp_ml_bench.loaders.render.scene import BuildSettings, UserMesh
from fpp_ml_bench.loaders.render.surfels import Surfels
from fpp_ml_bench.loaders.render.textures import material_of
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig

GREY = 188  # of which 0.503 is left in linear light
LINEAR_GREY = ((GREY / 255 + 0.055) / 1.055) ** 2.4
QUAD = "v 0 -0.1 -0.1\nv 0 0.1 -0.1\nv 0 0.1 0.1\nv 0 -0.1 0.1\n"


def loaded(path):
    return load_user_mesh(UserMesh(path.stem, str(path)))


def glb_header(content):
    """Length of the header of a GLB, and what it holds."""
    length = struct.unpack_from("<I", content, 12)[0]
    return length, json.loads(content[20 : 20 + length])


def write_quad(folder, image, name="quad.obj"):
    """A square of 0.2 m that faces the first view, as OBJ, MTL and PNG; u to its +y, v up."""
    text = (
        "mtllib quad.mtl\n"
        + QUAD
        + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    (folder / name).write_text(text)
    (folder / "quad.mtl").write_text("newmtl paint\nKd 0 0 0\nmap_Kd quad.png\n")
    Image.fromarray(image).save(folder / "quad.png")
    return folder / name


def two_colours(width=64):
    """Black on the left half, grey on the right one."""
    image = np.zeros((width, width, 3), dtype=np.uint8)
    image[:, width // 2 :] = GREY
    return image


def luminance(mesh, points):
    """Luminance at points (n, 3) of a mesh whose triangles lie in the plane x = 0."""
    corners = mesh.vertices_m[mesh.faces]
    weights = np.array(
        [barycentric(corners, np.broadcast_to(p, (len(corners), 3))) for p in points]
    )
    back = (weights[..., None] * corners[None]).sum(axis=2)
    triangle = np.linalg.norm(back - np.asarray(points)[:, None], axis=2).argmin(axis=1)
    assert mesh.paint is not None
    return mesh.paint.at(triangle, weights[np.arange(len(points)), triangle])


def test_luminance_is_that_of_the_standards():
    """IEC 61966-2-1: half of sRGB is 0.214 in linear light; BT.709: its weights add up to 1."""
    level = np.arange(256)
    linear = np.where(level <= 10, level / 255 / 12.92, ((level / 255 + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(
        linear_luminance(np.repeat(level.astype(np.uint8)[:, None], 3, 1)), linear, atol=1e-7
    )
    assert np.interp(0.5, level / 255, linear) == pytest.approx(0.2140, abs=1e-4)
    primaries = linear_luminance(np.diag([255, 255, 255]).astype(np.uint8))
    np.testing.assert_allclose(primaries, [0.2126, 0.7152, 0.0722], atol=1e-7)


def test_sixteen_bits_and_palettes_are_read_like_eight():
    grey = Image.fromarray(np.full((2, 3), GREY, dtype=np.uint8))
    deep = Image.fromarray(np.full((2, 3), GREY * 257, dtype=np.uint16))
    for image in (grey, deep, grey.convert("P"), grey.convert("RGBA")):
        np.testing.assert_allclose(texture_of(image), np.full((2, 3), LINEAR_GREY), rtol=1e-6)


def test_a_texture_is_sampled_between_its_pixels_and_repeats():
    image = np.array([[0.1, 0.5], [0.3, 0.9]], dtype=np.float32)
    at = [
        (0.25, 0.75),
        (0.75, 0.75),
        (0.25, 0.25),
        (0.5, 0.75),
        (0.5, 0.5),
        (1.25, -0.25),
        (0.0, 0.75),
    ]
    u, v = np.array(at).T
    expected = [0.1, 0.5, 0.3, 0.3, 0.45, 0.1, 0.3]
    np.testing.assert_allclose(bilinear(image, u, v), expected, atol=1e-6)


def test_a_quad_has_the_colours_of_its_image(tmp_path):
    """Also where they lie: u runs to the right, and up in the image is up in v."""
    image = two_colours()
    image[:32, :32] = 255  # white above on the left
    mesh = loaded(write_quad(tmp_path, image))
    points = [(0, -0.06, 0.03), (0, -0.02, -0.08), (0, 0.02, 0.03), (0, 0.09, -0.09)]
    np.testing.assert_allclose(luminance(mesh, points), [1, 0, LINEAR_GREY, LINEAR_GREY], atol=1e-6)


def test_weights_in_a_triangle_without_an_area_are_those_of_a_corner():
    np.testing.assert_array_equal(barycentric(np.zeros((1, 3, 3)), np.zeros((1, 3))), [[1, 0, 0]])


def test_a_glb_of_it_has_them_too(tmp_path):
    mesh = trimesh.load(write_quad(tmp_path, two_colours()), force="mesh", process=False)
    mesh.visual.material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=mesh.visual.material.image, baseColorFactor=[51, 51, 51, 255]
    )
    mesh.export(tmp_path / "quad.glb")
    mesh = loaded(tmp_path / "quad.glb")
    assert mesh.paint is not None and len(mesh.paint.images) == 1
    seen = luminance(mesh, [(0, -0.05, 0.03), (0, 0.05, 0.03)])
    np.testing.assert_allclose(
        seen, [0, 0.2 * LINEAR_GREY], atol=1e-6
    )  # the factor is linear, the image is not


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_vertex_colours_are_interpolated_in_linear_light(tmp_path, suffix):
    vertices = [[0, -0.1, -0.1], [0, 0.1, -0.1], [0, 0.1, 0.1]]
    colours = np.array([[0, 0, 0, 255], [GREY, GREY, GREY, 255], [255, 0, 0, 255]], dtype=np.uint8)
    path = tmp_path / f"triangle.{suffix}"
    trimesh.Trimesh(vertices, [[0, 1, 2]], vertex_colors=colours, process=False).export(path)
    mesh = loaded(path)
    grey = GREY / 255 if suffix == "glb" else LINEAR_GREY  # glTF stores them linear
    weights = np.array([[0.2, 0.5, 0.3], [0, 0, 1], [0.5, 0.5, 0]])
    points = weights @ np.array(vertices)
    np.testing.assert_allclose(luminance(mesh, points), weights @ [0, grey, 0.2126], atol=1e-6)


def test_face_colours_and_material_colours(tmp_path):
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    corners = [[float(x) for x in line.split()[1:]] for line in QUAD.splitlines()]
    colours = np.array([[GREY, GREY, GREY, 255], [0, 255, 0, 255]], dtype=np.uint8)
    trimesh.Trimesh(corners, faces, face_colors=colours, process=False).export(
        tmp_path / "faces.ply"
    )
    (tmp_path / "two.obj").write_text(
        "mtllib two.mtl\n" + QUAD + "usemtl grey\nf 1 2 3\nusemtl green\nf 1 3 4\n"
    )
    (tmp_path / "two.mtl").write_text(
        f"newmtl grey\nKd {3 * f'{GREY / 255} '}\nnewmtl green\nKd 0 1 0\n"
    )
    for name in ("faces.ply", "two.obj"):
        mesh = loaded(tmp_path / name)
        points = [(0, 0.06, -0.03), (0, -0.06, 0.03)]
        np.testing.assert_allclose(luminance(mesh, points), [LINEAR_GREY, 0.7152], atol=1e-6)


def test_meshes_without_colours_have_no_paint(tmp_path):
    (tmp_path / "plain.obj").write_text(QUAD + "f 1 2 3\nf 1 3 4\n")
    (tmp_path / "places.obj").write_text(
        QUAD + "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/2\n"
    )
    for name in ("plain.obj", "places.obj"):
        assert loaded(tmp_path / name).paint is None


@pytest.fixture(scope="module")
def light() -> Light:
    """Nothing but direct light, an ideal camera, and textures."""
    bare = named_light("paper").changed("surface", textures="by_kind", gloss=0.0)
    bare = bare.changed("bounces", interreflection=False, ambient_occlusion=False, shadows=False)
    return bare.changed("camera", full_well_e=None, rays_across=2).changed(ambient_grey=0.0)


def photographed(path, light):
    """Trace of the first view of a mesh."""
    mesh = UserMesh("quad", str(path))
    settings = BuildSettings(paper_rig(176), ("quad",), light=light, user_meshes=(mesh,))
    return Studio(settings).trace(load_user_mesh(mesh), "A0")


def test_a_photograph_of_the_quad_has_both_albedos(tmp_path, light):
    """Against the same quad all in white: the gains' ratio is the luminance, black at its least."""
    white = np.full((64, 64, 3), 255, dtype=np.uint8)
    gains = []
    for image in (two_colours(), white):
        scene = photographed(write_quad(tmp_path, image), light)
        gains.append((scene.lit.gain, scene.mixed_lit.gain))
    half, whole = gains
    ratio = half[0] / whole[0]
    dark, bright = np.isclose(ratio, 0.02, rtol=1e-4), np.isclose(ratio, LINEAR_GREY, rtol=1e-4)
    assert (
        abs(dark.mean() - 0.5) < 0.05
        and abs(bright.mean() - 0.5) < 0.05
        and (dark | bright).mean() > 0.9
    )
    on = (scene.mixed.triangle >= 0) & (whole[1] > 0)
    mixed = (
        half[1][on] / whole[1][on]
    )  # some of these rays are between pixels, also of the repeated image
    np.testing.assert_allclose([mixed.min(), mixed.max()], [0.02, LINEAR_GREY], rtol=1e-4)


def test_without_textures_the_albedo_is_even(tmp_path):
    mesh = loaded(write_quad(tmp_path, two_colours()))
    surface = named_light("paper").changed("surface", textures="none").surface
    assert (
        material_of(mesh, np.zeros((1, 3)), np.zeros((1, 3)), surface, np.array([0])).albedo == 0.8
    )


def test_triangles_without_an_area_do_not_shift_the_colours(tmp_path, light):
    """They are not traced, but count as rows of the faces."""
    text = write_quad(tmp_path, two_colours()).read_text()
    before = photographed(tmp_path / "quad.obj", light)
    (tmp_path / "quad.obj").write_text(
        text.replace("usemtl paint\n", "usemtl paint\nf 1/1 1/1 2/2\nf 2/2 3/3 2/2\n")
    )
    after = photographed(tmp_path / "quad.obj", light)
    np.testing.assert_allclose(after.lit.gain, before.lit.gain, rtol=1e-5)
    assert after.hits.triangle.min() >= 0


def test_points_of_surfels_know_their_triangles(tmp_path):
    """On an open surface too, whose points lie on both sides."""
    mesh = loaded(write_quad(tmp_path, two_colours()))
    points = Surfels.of(mesh).points
    corners = mesh.vertices_m[mesh.faces[points.triangle]]
    weights = barycentric(corners, points.position_m)
    np.testing.assert_allclose(
        (weights[:, :, None] * corners).sum(axis=1), points.position_m, atol=1e-12
    )


def test_the_hash_covers_materials_and_textures(tmp_path):
    path = write_quad(tmp_path, two_colours())
    before = single_mesh(path).content
    assert single_mesh(path).content == before and len(before) == 32
    Image.fromarray(two_colours() // 2).save(tmp_path / "quad.png")
    repainted = single_mesh(path).content
    (tmp_path / "quad.mtl").write_text("newmtl paint\nKd 0 0 1\nmap_Kd quad.png\n")
    assert len({before, repainted, single_mesh(path).content}) == 3


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda picture: picture.unlink(), "names the file 'quad.png', which is not beside it"),
        (
            lambda picture: picture.write_bytes(picture.read_bytes()[:900]),
            "its texture 'quad.png' can't be read",
        ),
        (
            lambda picture: picture.with_name("quad.mtl").write_text(
                "newmtl paint\nmap_Kd ../../elsewhere.png\n"
            ),
            "which is not beside it",
        ),
    ],
    ids=["missing", "cut", "outside"],
)
def test_damaged_textures_are_refused_in_words(tmp_path, damage, says):
    path = write_quad(
        tmp_path, np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    )
    damage(tmp_path / "quad.png")
    with pytest.raises(MeshError, match=says) as caught:
        loaded(path)
    assert str(path) in str(caught.value)


def test_a_damaged_image_inside_a_glb_is_refused(tmp_path):
    file = tmp_path / "quad.glb"
    trimesh.load(write_quad(tmp_path, two_colours()), force="mesh", process=False).export(file)
    content = bytearray(file.read_bytes())
    length, header = glb_header(content)
    view = header["bufferViews"][header["images"][0]["bufferView"]]
    start = 28 + length + view.get("byteOffset", 0)
    content[start : start + 8] = bytes(8)
    file.write_bytes(content)
    with pytest.raises(MeshError, match="can't be read"):
        loaded(file)


@pytest.mark.parametrize("suffixes", [("obj", "mtl", "png"), ("glb",)], ids=["obj", "glb"])
def test_changed_bytes_give_a_mesh_or_words(tmp_path, suffixes):
    mesh = trimesh.load(write_quad(tmp_path, two_colours(16)), force="mesh", process=False)
    mesh.export(tmp_path / "quad.glb")
    random, refused = np.random.default_rng(9), 0
    originals = {
        tmp_path / f"quad.{suffix}": (tmp_path / f"quad.{suffix}").read_bytes()
        for suffix in suffixes
    }
    for _ in range(60):
        for file, original in originals.items():
            content = bytearray(original)
            for place in random.integers(0, len(content), 3):
                content[place] = random.integers(0, 256)
            file.write_bytes(content)
        try:
            mesh = loaded(tmp_path / f"quad.{suffixes[0]}")
        except MeshError:
            refused += 1
            continue
        if mesh.paint is not None:
            weights = np.full((len(mesh.faces), 3), 1 / 3)
            assert np.isfinite(mesh.paint.at(np.arange(len(mesh.faces)), weights)).all()
    assert refused > 5


# ---- meshes of strangers


@pytest.mark.parametrize(
    "name, kind",
    [
        ("quad.mtl", "pipe"),
        ("quad.png", "device"),
        ("quad.png", "folder"),
    ],
)
def test_what_a_mesh_names_must_be_a_regular_file(tmp_path, name, kind):
    path = write_quad(tmp_path, two_colours())
    (tmp_path / name).unlink()
    makers = {
        "pipe": os.mkfifo,
        "device": lambda at: at.symlink_to("/dev/zero"),
        "folder": Path.mkdir,
    }
    makers[kind](tmp_path / name)
    with pytest.raises(
        MeshError,
        match=rf"^{path}: names the file '{name}', which is not (a regular file|beside it)",
    ):
        loaded(path)


def test_textures_are_counted_by_their_headers_before_any_is_decoded(tmp_path):
    path = write_quad(tmp_path, two_colours())
    header = struct.pack(">IIBBBBB", 1 << 14, (1 << 13) + 1, 8, 2, 0, 0, 0)
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", header), (b"IDAT", b"x"))
    ]
    (tmp_path / "quad.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(
        MeshError, match=r"has textures of 134234112 px, expected 134217728; shrink them"
    ):
        loaded(path)


def test_a_mesh_without_end_is_refused_by_its_header(tmp_path):
    content = trimesh.Scene(trimesh.creation.box()).export(file_type="glb")
    length, header = glb_header(content)
    header["nodes"] = header["nodes"][:1] + [{"mesh": 0}] * 20_001
    header["nodes"][0] = {"children": list(range(1, len(header["nodes"])))}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + content[20 + length :]
    (tmp_path / "many.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    with pytest.raises(
        MeshError, match=r"many\.glb: has 20002 parts, expected at most 20000; join them"
    ):
        loaded(tmp_path / "many.glb")


def test_materials_that_share_a_texture_hold_it_once(tmp_path):
    path = write_quad(tmp_path, two_colours())
    once = loaded(path).paint
    material = (tmp_path / "quad.mtl").read_text()
    (tmp_path / "quad.mtl").write_text(material + material.replace("newmtl paint", "newmtl again"))
    text = path.read_text().splitlines()
    faces = [line for line in text if line.startswith("f ")]
    path.write_text("\n".join([*text, "usemtl again", *faces]) + "\n")
    twice = loaded(path).paint
    assert len(once.images) == len(twice.images) == 1 and len(twice.image) == 2 * len(once.image)
    np.testing.assert_array_equal(once.images[0], twice.images[0])
