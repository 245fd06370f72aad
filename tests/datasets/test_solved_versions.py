"""Versions of photogrammetry exports: every one gives the same cameras; see `plain_captures`."""

import math
import re

import numpy as np
import pytest
from facts import assert_facts, raises
from plain_captures import (
    COUNT,
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    TRUTH,
    WIDTH,
    check,
    looking,
    matrix,
    picture,
    text,
)

from recon_cli.datasets.layouts import read_posed, recognise
from recon_cli.errors import InputError


def angles(pose):
    """Heading, pitch, roll of Rz(-heading) Rx(pitch) Ry(roll), found by search, in degrees."""
    from scipy.optimize import least_squares

    def turn(h, p, r):
        h, p, r = np.radians([-h, p, r])
        z = [[math.cos(h), -math.sin(h), 0], [math.sin(h), math.cos(h), 0], [0, 0, 1]]
        x = [[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]]
        y = [[math.cos(r), 0, math.sin(r)], [0, 1, 0], [-math.sin(r), 0, math.cos(r)]]
        return np.array(z) @ x @ y

    starts = [(h, p, 0.0) for h in range(-180, 180, 60) for p in (0.0, 60.0, 100.0)]
    fits = [least_squares(lambda v: (turn(*v) - pose[:3, :3]).ravel(), one, xtol=1e-15, ftol=1e-15)
            for one in starts]
    best = min(fits, key=lambda fit: fit.cost)
    assert best.cost < 1e-18
    return best.x


@pytest.mark.integration
@pytest.mark.parametrize("columns", [
    "name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2",
    "f,name,roll,pitch,heading,alt,y,x", "#cameras 5\n#name,x,y,alt,heading,pitch,roll,f,px,py"])
@pytest.mark.parametrize("suffix", [".jpg", ""])
def test_reality_scan_with_columns_in_any_order(tmp_path, columns, suffix):
    keys = columns.splitlines()[-1].lstrip("#").split(",")
    middle = "px" in keys
    lines = ["#" * (columns[0] not in "#f") + columns]
    longer = max(WIDTH, HEIGHT)
    for at in range(COUNT):
        picture(tmp_path / "photos" / f"img {at}.jpg", seed=at)
        place, (right, down, ahead) = looking(at)
        heading, pitch, roll = angles(matrix(place, right, -down, -ahead))
        row = dict(zip(("x", "y", "alt"), place, strict=True)) | {
            "name": f'"img {at}{suffix}"', "heading": heading, "pitch": pitch, "roll": roll,
            "f": FX * 36 / longer, "px": (CX - WIDTH / 2) / longer,
            "py": (CY - HEIGHT / 2) / longer}
        lines.append(",".join(str(row.get(key, 0)) for key in keys))
    text(tmp_path / "out.csv", "\n".join(lines) + "\n")
    assert recognise(tmp_path) == "realityscan"
    check(read_posed(tmp_path), depth=False, inner=(FX, FX, CX, CY) if middle else (
        FX, FX, WIDTH / 2, HEIGHT / 2))


def metashape(folder, *, component="full", initial=True, where="component", slave=False):
    """The chunk is half as large as the world, turned about z, and moved."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    scale, shift = (2.0, np.array([10.0, 20, 30])) if component == "full" else (1.0, np.zeros(3))
    turn = turn if component == "full" else np.eye(3)
    world = ("<transform><rotation>" + " ".join(map(str, turn.ravel())) + "</rotation><translation>"
             + " ".join(map(str, shift)) + f"</translation><scale>{scale}</scale></transform>")
    world = world * (component == "full")
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    first = f'<calibration class="initial">{size}<f>1</f><cx>9</cx></calibration>' * initial
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?><document version="1.5.0"><chunk label="a">'
        f'<sensors next_id="1"><sensor id="0" label="x" type="frame">{size}{first}'
        f'<calibration type="frame" class="adjusted">{size}<f>{FY}</f><cx>{CX - WIDTH / 2}</cx>'
        f"<cy>{CY - HEIGHT / 2}</cy><b1>{FX - FY}</b1></calibration></sensor>"
        '<sensor id="1" label="y" type="spherical"/></sensors>']
    if where == "component":
        lines.append(f'<components><component id="0">{world}</component></components>')
    lines.append("<cameras>")
    for at in range(COUNT):
        picture(folder / "img" / f"IMG {at}.JPG", seed=at)
        local = np.eye(4)
        local[:3, :3] = turn.T @ TRUTH[at][:3, :3]
        local[:3, 3] = turn.T @ (TRUTH[at][:3, 3] - shift) / scale
        label = (f"IMG {at}", f"IMG {at}.JPG", rf"C:\img\IMG {at}.JPG")[at % 3]
        component_id = 'component_id="0"' * (where == "component")
        lines.append(
            f'<camera id="{at}" sensor_id="0" {component_id} label="{label}"><transform>'
            + " ".join(map(str, local.ravel())) + "</transform></camera>")
    lines.append('<camera id="8" sensor_id="1" master_id="0" label="s"/>' * slave + "</cameras>")
    text(folder / "c.xml", "".join(lines) + world * (where == "chunk") + "</chunk></document>")


@pytest.mark.parametrize("more", [
    {}, {"initial": False}, {"component": "none"}, {"where": "chunk"}, {"slave": True}])
def test_metashape_by_its_versions(tmp_path, more):
    metashape(tmp_path, **more)
    assert recognise(tmp_path) == "metashape"
    posed = read_posed(tmp_path)
    assert posed.metric == (more.get("component") != "none")
    check(posed, depth=False)


def test_components_that_nothing_places_are_left_out(tmp_path):
    metashape(tmp_path, component="none")
    path = tmp_path / "c.xml"
    path.write_text(path.read_text().replace(
        '<component id="0">', '<component id="1"/><component id="0">').replace(
        'component_id="0" label="IMG 1.JPG"', 'component_id="1" label="IMG 1.JPG"'))
    posed = read_posed(tmp_path)
    assert len(posed.images) == COUNT - 1
    assert_facts("\n".join(posed.notices), 1, "further", "components")


@pytest.mark.parametrize("value", ["false", "False", "0"])
@pytest.mark.parametrize("group", ["", '<group label="g">', '<group label="g" enabled="{}">'])
def test_cameras_that_metashape_has_disabled_are_left_out_and_counted(tmp_path, value, group):
    metashape(tmp_path)
    path, off = tmp_path / "c.xml", f'enabled="{value}"'
    whole = "enabled" in group
    made = path.read_text().replace("<cameras>", "<cameras>" + group.format("true"))
    made = made.replace("</cameras>", "</group></cameras>" * bool(group) + "</cameras>" * (
        not group))
    if whole:  # all but those of the first group
        made = made.replace('<camera id="2"', f'</group><group label="h" {off}><camera id="2"')
    else:
        made = made.replace('<camera id="1"', f'<camera {off} id="1"')
    path.write_text(made)
    posed = read_posed(tmp_path)
    assert len(posed.images) == (2 if whole else COUNT - 1)
    assert any(f"{COUNT - len(posed.images)} frame" in notice and "disabled" in notice
               for notice in posed.notices)


def twice(folder, names, *, placed=True, labels=("left", "right")):
    """Writes one photo set in two folders, and two chunks whose cameras are labelled alike."""
    metashape(folder)
    text_ = (folder / "c.xml").read_text()
    for at in range(COUNT):
        image = folder / "img" / f"IMG {at}.JPG"
        for name in names:
            picture(folder / name / image.name, seed=at)
        text_ = text_.replace(rf"C:\img\IMG {at}.JPG", f"IMG {at}").replace(
            f'"IMG {at}.JPG"', f'"IMG {at}"')
        image.unlink()
    head, _, rest = text_.partition("<chunk")
    chunk = "<chunk" + rest.partition("</document>")[0]
    bare = re.sub(r"<component .*?</component>", '<component id="0"/>', chunk)
    second = chunk if placed else bare
    (folder / "c.xml").write_text(
        head + chunk.replace('label="a"', f'label="{labels[0]}"')
        + second.replace('label="a"', f'label="{labels[1]}"') + "</document>")


def test_equal_labels_of_two_chunks_are_told_apart_by_folders_of_their_names(tmp_path):
    twice(tmp_path, ("left", "right"))
    posed = read_posed(tmp_path)
    assert len(posed.images) == 2 * COUNT
    assert {image.path.parent.name for image in posed.images} == {"left", "right"}


def test_equal_labels_that_nothing_tells_apart_are_left_out_and_said(tmp_path):
    twice(tmp_path, ("one", "two"))
    with raises(InputError, "tells", "apart"):
        read_posed(tmp_path)


@pytest.mark.parametrize("placed", [True, False])
def test_a_photo_in_two_chunks_is_used_once(tmp_path, placed):
    twice(tmp_path, ("photos",), placed=placed)
    posed = read_posed(tmp_path)
    assert len(posed.images) == COUNT
    assert any(f"{COUNT} frames" in notice for notice in posed.notices)


def test_bundler_llff_and_opensfm(tmp_path):
    lines, rows, shots = ["# Bundle file v0.3", f"{COUNT} 0"], [], {}
    for at in range(COUNT):
        place, (right, down, ahead) = looking(at)
        for kind in ("bundler", "llff/images", "opensfm/images"):
            picture(tmp_path / kind / f"{at}.jpg", seed=at)
        # Bundler: a point p is at R p + t, x right, y up, looking along -z
        turn = np.stack([right, -down, -ahead])
        lines += [f"{FX} 0 0", *(" ".join(map(str, row)) for row in (*turn, -turn @ place))]
        rows.append([*np.column_stack([down, right, -ahead, place, [HEIGHT, WIDTH, FX]]).ravel(),
                     0.5, 9.0])
        turn = np.stack([right, down, ahead])
        angle = math.acos((np.trace(turn) - 1) / 2)
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        shots[f"{at}.jpg"] = {"camera": "c", "rotation": (
            axis / (2 * math.sin(angle)) * angle).tolist(), "translation": (-turn @ place).tolist()}
    text(tmp_path / "bundler" / "bundle.out", "\n".join(lines) + "\n")
    text(tmp_path / "bundler" / "list.txt", "".join(f"{at}.jpg\n" for at in range(COUNT)))
    np.save(tmp_path / "llff" / "poses_bounds.npy", rows)
    text(tmp_path / "opensfm" / "reconstruction.json", [{"shots": shots, "points": {}, "cameras": {
        "c": {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT,
              "focal": FX / WIDTH, "k1": 0, "k2": 0}}}])
    for kind in ("bundler", "llff", "opensfm"):
        assert recognise(tmp_path / kind) == kind
        posed = read_posed(tmp_path / kind)
        found = [np.linalg.inv(image.viewmat) for image in posed.images]
        np.testing.assert_allclose(found, TRUTH, atol=1e-5)
        np.testing.assert_allclose(posed.images[0].lens.params[0], FX)
