"""From a seed to a scene (`sampling`), to an image (`samples`), to a folder of images (`render`).

This package imports `records` alone, and no torch; `blender` imports bpy when the first image is rendered.
"""
