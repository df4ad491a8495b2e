"""What the page of the viewer draws itself: surfels or points, and cameras."""

from typing import Any

import numpy as np
from viser.transforms import SO3

from jaxcloseup.app.view.picking import vertical_fov
from jaxcloseup.app.view.viewer import Viewer
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.geometry.cameras import Camera


_ANGLE = 1e-4  # radians up to which two rotations are one


def add_scene(scene: Any, viewer: Viewer) -> Any:
    """Draw a run's surfels, or the points of a scene without any; return Viser's handle, or None.

    Args:
      scene: of a client of Viser's server.
      viewer: the run.
    """
    gaussians = viewer.drawn()
    if gaussians is not None:
        # Viser stores covariances in 16 bits, so scale the largest radius to 100 units.
        variances = np.trace(gaussians.covariances, axis1=1, axis2=2)
        unit = np.sqrt(variances.max(initial=1e-18)) / 100
        return scene.add_gaussian_splats(
            "/surfels",
            gaussians.means / unit,
            gaussians.covariances / unit**2,
            gaussians.rgb,
            gaussians.opacities[:, None],
            scale=unit,
        )
    if len(viewer.scene.points):
        points, rgb = viewer.scene.points, to_uint8(viewer.scene.rgb[None])[0]
        return scene.add_point_cloud("/points", points, rgb, point_size=0.003 * viewer.distance)
    return None


def add_frustum(scene: Any, name: str, camera: Camera, size: float, image: np.ndarray) -> Any:
    """Draw a training camera of a size with its photograph; return Viser's handle."""
    return scene.add_camera_frustum(
        name,
        vertical_fov(camera),
        camera.width / camera.height,
        scale=size,
        thickness=1.5,
        thickness_units="screen",
        color=(150, 150, 150),
        image=image,
        wxyz=quaternion(camera),
        position=np.asarray(camera.position),
    )


def quaternion(camera: Camera) -> np.ndarray:
    """Return a camera's rotation as w, x, y and z."""
    return SO3.from_matrix(np.asarray(camera.rotation, np.float64)).wxyz


def same(camera: Camera, other: Camera, *, within: float) -> bool:
    """Return whether two cameras show the same, if positions `within` each other are one."""
    if (camera.width, camera.height) != (other.width, other.height):
        return False
    ours, theirs = (np.asarray(each.camtoworld, np.float64) for each in (camera, other))
    lens = np.allclose(np.asarray(camera.intrinsics), np.asarray(other.intrinsics), rtol=1e-4)
    turned = np.allclose(ours[:, :3], theirs[:, :3], atol=_ANGLE)
    return lens and turned and bool(np.linalg.norm(ours[:, 3] - theirs[:, 3]) <= within)
