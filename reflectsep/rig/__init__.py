"""The rig: stage, camera and lights behind small protocols; the plan as data; the session on disk; the runner."""
