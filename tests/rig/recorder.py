"""A video camera whose recordings a test makes: of what a simulated camera sees meanwhile."""

from fractions import Fraction
from pathlib import Path

from reflectsep.rig.camera_video import VideoCamera


class Recorder(VideoCamera):
    """`spoil`, where it is set, gets the path of a sweep's video and its pictures with times, to do what it likes."""

    def __init__(self, eye, **settings):
        super().__init__(**settings)
        self._eye, self._frames_seen = eye, []
        self.spoil = None

    def connect(self):
        self._eye.connect()

    def snap(self, name):
        self.write(self._path.replace("{name}", name.replace("/", "-")), [(0.0, self._eye.snap(name).pixels)])
        return super().snap(name)

    def start(self, name, rate_hz):
        super().start(name, rate_hz)
        self._frames_seen = []
        self._eye.start(name, rate_hz)

    def poll(self):
        self._frames_seen += self._eye.poll()
        return ()

    def stop(self):
        if self._taking is None:
            return ()
        self._frames_seen += self._eye.stop()
        first = self._frames_seen[0].device_time_s
        pictures = [(f.device_time_s - first, f.pixels) for f in self._frames_seen]
        path = Path(self._path.replace("{name}", self._taking))
        self.write(path, pictures)
        if self.spoil is not None:
            self.spoil(path, pictures)
        return super().stop()

    @staticmethod
    def write(path, pictures):
        """A video of pictures at their times, with a rate in its header that is not theirs."""
        import av

        with av.open(str(path), "w") as container:
            stream = container.add_stream("ffv1", rate=25)
            stream.width, stream.height, stream.pix_fmt = 16, 12, "gray"
            stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
            for time_s, pixels in pictures:
                frame = av.VideoFrame.from_ndarray(pixels, format="gray")
                frame.pts, frame.time_base = round(time_s * 1000), Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
