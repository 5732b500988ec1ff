"""Event-based multi-view stereo (EMVS): a semi-dense depth map and cloud from events and known camera poses.

Optional module: nothing else in this project imports it. Written from the published description in
H. Rebecq, G. Gallego, E. Mueggler, D. Scaramuzza, "EMVS: Event-Based Multi-View Stereo - 3D Reconstruction with an
Event Camera in Real-Time", International Journal of Computer Vision 126 (2018), 1394-1414; no code of its authors is
used. The method is named in the patent application WO/2018/037079: whoever wants to use this module commercially
should check first whether a patent applies where they are.

Every event is a ray from the camera at the time of the event. Rays are sampled on planes parallel to a reference
view (the disparity space image, DSI); where many rays meet, there is an edge of the scene.
"""

from __future__ import annotations

from utils.emvs.mapper import EmvsMap, View, map_events
from utils.emvs.settings import EmvsSettings

__all__ = ["EmvsMap", "EmvsSettings", "View", "map_events"]
