"""The former place of the sites, which names the present one to those who import from it."""

raise ImportError("greenroof_ros.model.site is now greenroof_ros.site.site")
