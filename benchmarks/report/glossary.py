"""The terms of a report: explained to the pointer wherever they stand, and listed at its end."""

import re

GLOSSARY = {
    "PSNR": "Peak signal-to-noise ratio in decibels: 10 log10 of one over the mean squared error. Higher is better; "
    "one decibel is an error smaller by a fifth.",
    "SSIM": "Structural similarity (Wang et al. 2004), 11x11 Gaussian window, sigma 1.5; 1 is identical.",
    "FLIP": "The difference that a viewer sees when flipping between two images (Andersson et al. 2020), at 67 pixels "
    "per degree; 0 is identical.",
    "LPIPS": "Distance of deep features of AlexNet (Zhang et al. 2018), times 1000, on the whole frame; lower is "
    "better.",
    "IoU": "Overlap of the drawn silhouette and the true one: intersection over union; 1 is identical.",
    "template": "The deformable mesh that a method is given or learns, and on which its Gaussians or its texture lie.",
    "template error": "Root mean square distance between vertices of the method's posed template and the true "
    "surface's.",
    "exact surface": "The true surface in place of a learned template: such a method is a bound and no competitor.",
    "to surface": "Mean distance of Gaussian centres from the true surface.",
    "flicker": "How far the change from frame to frame differs from the truth's own, in steps of 1/255.",
    "noise ceiling": "The PSNR of a perfect method: what the noise of the path-traced truth itself allows.",
    "foreground": "The pixels that the subject truly covers by more than half: background would only dilute a score.",
    "release crop": "As the released ASH code validates: masked, on white, cut to a window, blind outside the "
    "silhouette.",
    "novel views": "Cameras that no method was trained on, in frames of the training motion.",
    "novel poses": "A motion that no method was trained on, seen by cameras that none was trained on.",
    "near novel poses": "Another take of a kind of motion that was trained on.",
    "far novel poses": "Motion unlike all that was trained on: arms stretched up, a deep squat, a jump.",
    "novelty": "How far a pose lies from the nearest training pose, in degrees: the mean over the joints of the "
    "geodesic angle between their rotations in their parents' frames, the heading removed.",
    "training view": "Images that the method was trained on.",
    "frame time": "Milliseconds to draw a frame of near novel poses on one core: median over frames after warm-up.",
    "Stg.1": "The paper's first stage: the template is posed and deformed.",
    "Stg.2": "The paper's second stage: the motion-aware textures are made.",
    "Stg.3": "The paper's third stage: decoders turn textures into Gaussians, or into a texture.",
    "Stg.4": "The paper's fourth stage: Gaussians are skinned and splatted, or the mesh is drawn.",
    "training time": "Seconds of training on one core, warm-up included.",
    "CPU time": "Seconds that the method's processes kept a processor busy during training, counted from outside. Less "
    "than the clock's where they were stopped or shared a core, more where they used several.",
    "not isolated": "Trained where the system could not isolate the method's process: the truth was not given to it, "
    "and access to it was watched, but not made impossible.",
    "gap": "PSNR on training views minus PSNR here. Large: overfitting. Below zero: the images here are easier.",
    "settled": "Seconds of training after which no score of reserved views differs by more than 0.3 dB from the last.",
    "steps": "How many steps of the optimiser training took.",
    "cameras seen": "How many of the capture's training cameras the method learned from.",
    "frames seen": "How many of the capture's training frames the method learned from.",
    "plateau": "The last third of training gained less than 0.1 dB on reserved training views.",
    "memory": "Peak resident memory of the process, Python and libraries included.",
    "parameters": "How many numbers the method learned.",
    "Gaussians": "How many splats are drawn; a mesh has none. Neither more nor fewer is better.",
    "smallest sufficient": "The cheapest method whose loss to the best has a one-sided 95 % bound below 0.5 dB.",
    "Welch": "Welch's t test: two means of unequal variance, here over the seeds of a single capture.",
    "paired t": "Student's t test of the differences between two methods, a mean over seeds for each capture.",
    "Holm": "Holm's correction (1979): keeps the chance of any false alarm among all rows at 5 %.",
    "people needed": "How many people would decide what is unclear, with 80 % power after correction, if mean and "
    "spread of the difference are those found here.",
    "breakdown point": "The least severity at which a method scores below the midpoint between its score on the clean "
    "capture and that of the nearest training image, compared person by person, with the upper bound of the interval.",
    "seed": "The start of the random numbers of a training.",
    "preset": "A complete configuration by name: resolution, steps of training, sizes of networks.",
    "capture": "What methods are trained and scored on: a synthetic subject filmed by many cameras, with its exact "
    "truth.",
    "scene": "What a capture shows: a body, its clothes, its motion and its light.",
    "cell": "One method trained once on one capture.",
}
ROWS = {  # what our main rows are
    "ash": "the paper: Gaussians on a deforming mesh, drawn by networks that see the motion",
    "ash_plus": "ASH with this project's additions",
    "ddc": "a deforming mesh with a texture by networks",
    "ddc_plus": "DDC with the same additions",
    "ash_truth": "a bound, not ranked",
    "ddc_truth": "a bound, not ranked",
    "wo_mot": "ASH without motion as input",
    "wo_disp": "ASH without displacement of Gaussians",
}
FORMS = {
    **{term.lower(): term for term in GLOSSARY},
    "frame [ms]": "frame time",
    "novel view": "novel views",
    "novel pose": "novel poses",
}
LONGEST_FIRST = "|".join(re.escape(form) for form in sorted(FORMS, key=len, reverse=True))
WORDS = re.compile(rf"(?<![\w.])({LONGEST_FIRST})(?!\w)", re.IGNORECASE)


def anchor(term: str) -> str:
    """The name of a term's place in the page."""
    return "term-" + re.sub(r"\W+", "-", term.lower())


def meaning(text: str) -> str:
    """What the first term in a text means; empty without one."""
    return next((GLOSSARY[term] for _, term in split_terms(text) if term), "")


def split_terms(text: str) -> list[tuple[str, str]]:
    """The text in pieces, each with its term or an empty string; of several mentions only the first is a term."""
    pieces: list[tuple[str, str]] = []
    used: set[str] = set()
    for index, piece in enumerate(WORDS.split(text)):
        term = FORMS[piece.lower()] if index % 2 and FORMS[piece.lower()] not in used else ""
        used.add(term)
        pieces.append((piece, term))
    return pieces
