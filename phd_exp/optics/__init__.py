"""Real cameras and their virtual ones, with numpy alone: lenses, and square views that face a box."""
