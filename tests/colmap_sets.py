"""Small COLMAP data sets in every form: written by pycolmap, with rigs, and by hand as of old."""


import numpy as np
import posed_sets
import pycolmap

WIDTH, HEIGHT = posed_sets.WIDTH, posed_sets.HEIGHT
FORMS = ("bin", "txt")
PARAMS = (30.0, 31.0, 16.5, 11.0, 0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08)
OLD_CAMERAS = "# Camera list\n3 PINHOLE 32 24 30 31 16.5 11\n"
OLD_IMAGES = """# Image list with two lines of data per image:
# Number of images: 2
7 1 0 0 0 1 2 3 3 a b.png
1.5 2.5 -1 3.5 4.5 9
5 0.7071067811865476 0 0 0.7071067811865476 0 0 1 3 c.png

"""
OLD_POINTS = "# Points\n9 1 2 3 4 5 6 0.5 7 1 5 0\n2 -1 -2 -3 255 0 1 0.25\n"


def moved(angle, place):
    rotation = pycolmap.Rotation3d(np.array([0, np.sin(angle), 0, np.cos(angle)]))  # xyzw
    return pycolmap.Rigid3d(rotation, np.array(place, float))


def rig_model(frames=3, kind="PINHOLE", params=PARAMS[:4]):
    """Frames of a rig of two cameras, the second beside the first and turned, and two points."""
    made = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for camera_id in (1, 2):
        made.add_camera(pycolmap.Camera(
            camera_id=camera_id, model=kind, width=WIDTH, height=HEIGHT, params=list(params)))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
        if camera_id == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, moved(0.3, [0.5, 0, 0]))
    made.add_rig(rig)
    for at in range(frames):
        frame = pycolmap.Frame(frame_id=at + 1, rig_id=1)
        frame.rig_from_world = moved(0.1 * at, [at, 0.25, 1])
        images = []
        for camera_id in (1, 2):
            image = pycolmap.Image(
                image_id=frames * (camera_id - 1) + at + 1, name=f"cam{camera_id}/{at}.png",
                camera_id=camera_id,
                points2D=[pycolmap.Point2D(np.array([1.5, 2.5]))])
            frame.add_data_id(image.data_id)
            image.frame_id = at + 1
            images.append(image)
        made.add_frame(frame)
        for image in images:
            made.add_image(image)
        made.register_frame(at + 1)
    for place, color in (([0, 2, 5], [255, 0, 7]), ([1, 2, 5], [1, 2, 3])):
        made.add_point3D(np.array(place, float), pycolmap.Track(), np.array(color, np.uint8))
    return made


def write(folder, made, form, place="sparse/0"):
    (folder / place).mkdir(parents=True, exist_ok=True)
    (made.write_binary if form == "bin" else made.write_text)(folder / place)
    for image in made.images.values():
        posed_sets.write_image(folder / "images" / image.name)
    return folder


def write_old(folder):
    """Writes a model by hand, as COLMAP did before rigs and frames."""
    (folder / "sparse").mkdir()
    for name, text in (
            ("cameras", OLD_CAMERAS), ("images", OLD_IMAGES), ("points3D", OLD_POINTS)):
        (folder / "sparse" / f"{name}.txt").write_text(text)
    for name in ("a b.png", "c.png"):
        posed_sets.write_image(folder / "images" / name)
    return folder
