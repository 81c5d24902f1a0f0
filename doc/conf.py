"""Settings of the documentation: Sphinx with MyST, ``make docs``."""

import importlib.util
import os
import sys

# Sphinx reads this file in its own directory.
sys.path[:0] = [os.path.abspath("."), os.path.abspath("..")]  # noqa: PTH100

from greenroof_ros import __version__

project = "greenroof_ros"
author = "greenroof_ros maintainers"
copyright = "the greenroof_ros maintainers, Apache-2.0"
release = __version__

extensions = [
    "myst_parser",  # Markdown
    "sphinx.ext.autodoc",  # API pages from the docstrings,
    "sphinx.ext.autosummary",  # one for each module
    "sphinx.ext.napoleon",  # Google's docstring sections
    "docstrings_and_formulas",  # next to this file
]
exclude_patterns = [
    "_build", "_templates", "README.md",  # which index.rst includes
    # Files that rosdoc2 adds to these pages.
    "greenroof_ros*.rst", "modules.rst", "user_docs*", "standards.rst", "standard_docs",
    "interfaces", "__*.rst",
]
templates_path = ["_templates"]

# A broken link is an error (-W). Not documented here are names outside this package, private ones,
# names of types, and constants, which have comments in the source.
nitpicky = True
# An attribute named as a builtin, such as Parameter.range, is no other target for the builtin.
suppress_warnings = ["ref.python"]
nitpick_ignore_regex = [
    (r"py:.*", r"(?!greenroof_ros).*"), (r"py:.*", r".*\._\w+"), (r"py:data", r".*"),
    (r"py:(class|obj)", r".*\.(Amount|Cell|Record|S|Word)"),
]

highlight_language = "none"
smartquotes_action = "qe"  # quotes and ellipses; -- begins an option
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 4

html_theme = "furo"
html_title = f"greenroof_ros {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_math_renderer = "mathml"

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# Without ROS 2 the nodes' pages are built with mocks, likewise without Gymnasium.
_others = ("rclpy", "std_msgs", "rosgraph_msgs", "diagnostic_msgs", "rcl_interfaces", "gymnasium")
autodoc_mock_imports = [name for name in _others if importlib.util.find_spec(name) is None]
