"""Old names that still work for one release: commands and formats, and what each is called now."""

OLD_COMMANDS: dict[str, tuple[str, ...]] = {  # old command -> what is typed in its place; arguments follow unchanged
    "merge": ("report",),
    "rescore": ("eval", "--scores-only"),
    "retarget": ("eval",),
    "suites": ("run", "--list"),
    "undistort": ("export", "--format", "undistorted"),
    "export-avatar": ("export",),
    "share": ("export", "--format", "html"),
    "video": ("export", "--format", "mp4"),
}

OLD_FORMATS = {"glb": "gltf"}  # of `export`, for avatars

OLD_FIELDS = {  # of configurations and scenes, as flags and as keys of a suite's file
    "rig.part": "rig.cameras_per_frame",
}
OLD_METHODS = {  # rows that are others now
    "ash_wo_base": "ash",
    "ddc_wo_base": "ddc",
    "wo_motion_offset": "wo_disp",
    "wo_offset": "wo_disp",
}
OLD_SUITES = {"ladder": "factors"}
OLD_SIZES = {"rung": "factor"}  # of scenes
