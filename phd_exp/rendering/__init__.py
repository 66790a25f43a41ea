"""A seed becomes a scene (`sampling`), a scene an image (`blender`), and images a folder (`render`).

Imports the records alone, and no torch; bpy is imported in `blender` alone, when the first image is rendered.
"""
