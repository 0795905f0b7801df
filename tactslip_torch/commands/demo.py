"""The detectors that come with the package, each on its sample recording: ``tactslip demo``."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path


def demo(folder: Path) -> None:
    """Find the slip of the sample recording, draw it, export the detector, copy the page.

    Then the same, without a page, with a real recording.

    Args:
        folder: for ``detector.pt``, ``recording.npz``, the results of ``detect``, both ONNX files
            and the page; real recordings, with their detector and results, go into ``real``.

    Raises:
        FileExistsError: if the folder is there and not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} is there and not empty; give another one, --out DIR")
    from tactslip_torch.commands.configuration import compose_config  # not for --help
    from tactslip_torch.commands.detect import detect
    from tactslip_torch.commands.hosts import copy_host
    from tactslip_torch.deploy.export import export_detector
    from tactslip_torch.model.detector import SlipDetector
    from tactslip_torch.pretrained import NAME, RECORDING, sample_recording

    detector, recording = SlipDetector.pretrained(NAME), sample_recording()
    folder.mkdir(parents=True, exist_ok=True)
    model, place = folder / "detector.pt", folder / "recording.npz"
    detector.save(model)
    shutil.copyfile(RECORDING, place)
    config = compose_config("detect")
    config.model, config.input = str(model), str(place)
    (found,) = detect(config, folder)["recordings"]
    export_detector(detector, folder, source=model)
    page = copy_host("web", folder)
    for name in ("stream.onnx", "stream.onnx.json", "recording.npz"):
        shutil.copyfile(folder / name, page / name)
    (onset_s,) = recording.onsets_s
    alarms = [alarm for alarm in found["alarms"] if alarm["alarm_s"] >= onset_s]
    if alarms:
        alarm_s, at_s = alarms[0]["alarm_s"], alarms[0]["onset_s"]
        print(
            f"\nThe slip began at {onset_s:.3f} s. The detector raised its alarm at {alarm_s:.3f} s"
            f", {1e3 * (alarm_s - onset_s):.0f} ms later, and puts the onset at {at_s:.3f} s."
        )
    else:
        print(f"\nThe slip began at {onset_s:.3f} s. The detector raised no alarm.")
    print("Detector and recording are simulated.")
    real = _real(folder / "real")
    print(
        f"\npicture       {folder / 'recording_onsets.png'}\n"
        f"ONNX files    {folder / 'model.onnx'}, {folder / 'stream.onnx'}\n"
        f"page          needs Node 18 or later and, once, the internet:\n"
        f"              cd {page} && npm ci && node serve.mjs\n"
        f"              then open the address it prints: the recording plays\n"
        f"live          needs pip install websockets:\n"
        f"              tactslip stream model={model} source={place} serve=true repeat=true\n"
        f"real          {real}\n"
        f"              tactslip setup {real}   looks at them, as at yours; then\n"
        f"              tactslip train {real}"
    )


def _real(folder: Path) -> Path:
    """Write the real recordings and detect in the one that its detector was not trained on.

    Returns:
        The folder of the recordings.
    """
    from tactslip_torch.commands.configuration import compose_config
    from tactslip_torch.commands.detect import detect
    from tactslip_torch.model.detector import SlipDetector
    from tactslip_torch.pretrained import HELD_OUT, REAL_NAME, real_onset_s, write_real_recordings

    recordings, model = folder / "recordings", folder / "detector.pt"
    write_real_recordings(recordings)
    SlipDetector.pretrained(REAL_NAME).save(model)
    config = compose_config("detect")
    config.model, config.input = str(model), str(recordings / HELD_OUT)
    (found,) = detect(config, folder)["recordings"]
    alarms = ", ".join(f"{alarm['alarm_s']:.2f} s" for alarm in found["alarms"]) or "none"
    print(
        f"\nReal recording of two XELA uSkin fingers that lose a box: it slips from "
        f"{real_onset_s():.2f} s on, alarms at {alarms}.\n"
        "Its detector was trained on six others, too few to say how often it is right."
    )
    return recordings


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="tactslip demo",
        description="Find the slip in the recordings that come with the package, a simulated and "
        "a real one, draw it, and write a detector as ONNX with a page for the browser.",
        epilog="example: tactslip demo --out first",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("tactslip-demo"), metavar="DIR",
        help="a new folder for what is written (default: %(default)s)",
    )  # fmt: skip
    given = parser.parse_args()
    from tactslip_torch.commands.stopping import errors_in_one_line

    with errors_in_one_line():
        demo(given.out)
