"""Maximum adhesion: slip of the axles, and the track-condition map learnt from it."""
