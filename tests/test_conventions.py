"""Every function of the package follows one set of conventions."""

import ast
import collections
import pathlib
import re


PACKAGE = pathlib.Path(__file__).parents[1] / "jaxcloseup"

MODULES = {str(path.relative_to(PACKAGE)): path for path in sorted(PACKAGE.rglob("*.py"))}
SCRIPTS = {str(path): path for path in sorted((PACKAGE.parent / "experiments").rglob("*.py"))}
ROOMS = ("geometry", "photos", "fields", "labels", "detail", "training", "metrics", "stereo")
PUBLIC = [name for name in MODULES if name.split("/")[0] in ROOMS]
LONGEST_MODULE, LONGEST_FUNCTION, MOST_POSITIONAL = 300, 60, 7
# A docstring begins with a verb: what the function does, not what its result is.
_VERBS = """
Accumulate Add Advance Align Append Apply Assemble Assign Attach Average Backpropagate Bake Begin
Bind Blend Blur Build Change Check Choose Click Clip Clone Close Cluster Collect Color Combine
Compare Complete Composite Compute Connect Continue Convert Copy Count Create Crop Cull Cut Decode
Delete Describe Differentiate Divide Do Double Download Draw Drop Edit Encode End Enlarge Escape
Estimate Evaluate Expand Explain Extend Extract Fill Filter Find Fit Fold Format Forward Fuse
Gather Group Grow Guess Handle Hash Hide Hold Ignore Import Initialize Integrate Interpolate
Intersect Invert Join Judge Keep Label Leave Let List Listen Load Lock Log Look Lower Make Map
Mark Match Measure Merge Minimize Mix Model Move Multiply Name Normalize Open Order Pack Pad Parse
Perturb Pick Place Plan Pool Predict Prefer Prefilter Prepare Print Project Prune Pull Put Queue
Raise Rank Read Record Reduce Refine Refuse Relocate Remove Render Renew Repeat Replace Report
Request Require Resample Reset Reshape Resize Resolve Restore Restrict Return Reuse Rotate Round
Run Sample Save Scale Score Select Send Serve Set Settle Share Shift Show Shrink Skip Smooth Solve
Sort Splat Split Spread Stack Start Stop Store Subtract Sum Sweep Take Tell Time Train Transform
Triangulate Try Turn Unpack Update Use Wait Warn Warp Watch Weigh Widen Write Yield
"""
VERBS = set(_VERBS.split())
# Names that mean the same as another one of the vocabulary.
SYNONYMS = {
    "cam": "camera",
    "cams": "cameras",
    "coords": "pixels",
    "uv": "pixels",
    "image_height": "height",
    "image_width": "width",
    "rng": "key",
    "rng_key": "key",
    "seed_key": "key",
    "depth_map": "depth",
    "photos": "views",
    "tol": "tolerance",
}
# Names that modules may share, and why.
SHARED_NAMES = {
    "__init__": "packages",
    "config": "the static configurations of a room",
    "regularizers": "losses of splats, and of volumes",
    "residuals": "of any model, and of a run's states with OpenCV's rounding",
    **dict.fromkeys(
        ("mipnerf", "nerf", "ngp", "surfels", "tensorf", "zipnerf"), "field and method"
    ),
}


def functions(name, *, public=True):
    """Functions and methods of a module, with their class's name in front."""
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    for node in tree.body:
        inner = node.body if isinstance(node, ast.ClassDef) else [node]
        for function in inner:
            if isinstance(function, ast.FunctionDef):
                hidden = function.name.startswith("_") or node.name.startswith("_")
                if not (public and hidden):
                    yield function


def faults_of_docstrings(name):
    for function in functions(name):
        first = re.match(r"\w*", ast.get_docstring(function) or "")[0]
        if first not in VERBS:
            yield f"{function.name}: the docstring begins with {first!r}, not with a known verb"


def faults_of_arguments(name):
    for function in functions(name):
        positional = [argument.arg for argument in function.args.posonlyargs + function.args.args]
        named = [argument for argument in positional if argument not in ("self", "cls")]
        everything = named + [argument.arg for argument in function.args.kwonlyargs]
        for argument in everything:
            if argument in SYNONYMS:
                yield f"{function.name}: {argument} should be {SYNONYMS[argument]}"
        if "key" in named[1:]:
            yield f"{function.name}: key is not the first argument"
        if len(named) > MOST_POSITIONAL:
            yield f"{function.name}: {len(named)} positional arguments; make options keyword-only"
        heights = [argument for argument in everything if argument in ("height", "width")]
        if len(heights) == 2 and heights != ["height", "width"]:
            yield f"{function.name}: height and width stand together, height first"


def faults_of_lengths(name):
    text = (MODULES | SCRIPTS)[name].read_text(encoding="utf-8")
    if len(text.splitlines()) > LONGEST_MODULE:
        yield f"the module has {len(text.splitlines())} lines"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            lines = node.end_lineno - node.lineno + 1
            if lines >= LONGEST_FUNCTION:
                yield f"{node.name} has {lines} lines"


# Functions that do not order their arguments so, and why.
EXCEPTIONS = {
    "pull_back": "arithmetic of a compositor's inner loop takes one value after another",
    "mean_divergence": "a supervision is what it is a method of",
    "rendered_loss": "arguments in the order of RadianceField.render, whose key comes last",
    "rendered_gradient": "as rendered_loss",
}


def check(faults, name):
    found = [fault for fault in faults(name) if fault.split(":")[0] not in EXCEPTIONS]
    assert not found, f"{name}: " + "; ".join(found)


def test_docstrings_begin_with_a_verb():
    for name in MODULES:
        check(faults_of_docstrings, name)


def test_arguments_come_in_one_order_from_one_vocabulary():
    for name in PUBLIC:
        check(faults_of_arguments, name)


def test_modules_and_functions_are_short():
    for name in MODULES | SCRIPTS:
        check(faults_of_lengths, name)


def test_no_two_modules_have_one_name():
    # Programs are named as users call them.
    stems = [path.stem for path in MODULES.values() if path.parent.name != "cli"]
    twice = {name for name, count in collections.Counter(stems).items() if count > 1}
    assert not twice - SHARED_NAMES.keys()


def test_top_level_names_are_imported_for_type_checkers_too():
    text = MODULES["__init__.py"].read_text(encoding="utf-8")
    lazy = set(re.findall(r'"[\w.]+": \(?\s*"([\w ]+)"', text))
    names = {name for group in lazy for name in group.split()}
    tree = ast.parse(text)
    typed = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.If)
        for statement in node.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    assert typed == names
