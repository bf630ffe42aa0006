"""Joining a run and answering its steps."""

import ctypes
import fcntl
import os
import random
import re
import shutil
import stat
import time

import iceoryx2

from . import _schemas as s
from ._view import Partners, ZoneView, as_array

#: Seconds of polling before sleeping between polls.
_BUSY_S = 0.002
_NAP_S = 0.0001
#: The file in a run's directory by which it is known.
_MARKER = ".cz-run"


class Error(Exception):
    """Why a controller cannot go on."""


class Run:
    """The run a controller has joined.

    Attributes:
        spec: `schemas.RunSpec`: step, limits, distances, gains.
        approaches: list of `schemas.ApproachSpec`; names: `ZONE.APPROACH` of each.
        index: own index among the controller processes.
        lengths: `lengths[zone][path]`, m; own: set of (zone, path) this controller drives.
    """

    def __init__(self, data, index):
        size = ctypes.sizeof(s.RunSpec)
        if len(data) < size:
            raise Error(f"the world's reply has {len(data)} bytes, which is not a run specification")
        self.spec = s.RunSpec.from_buffer_copy(data)
        self.index = index
        self.approaches = []
        for _ in range(self.spec.approaches):
            self.approaches.append(s.ApproachSpec.from_buffer_copy(data, size))
            size += ctypes.sizeof(s.ApproachSpec)
        self.names = bytes(data[size:]).decode().splitlines()
        self.lengths = {}
        self.zone_names = {}
        for a, name in zip(self.approaches, self.names):
            self.lengths.setdefault(a.zone, {})[a.path] = a.length_m
            self.zone_names[a.zone] = name.split(".")[0]
        self.own = {(a.zone, a.path) for a in self.approaches if a.flags & s.APPROACH_OWN}
        self.own_zones = sorted({zone for zone, _ in self.own})


def name_hash(name):
    """FNV-1a, 64 bits: how a controller's name travels."""
    h = 0xCBF29CE484222325
    for byte in name.encode():
        h = (h ^ byte) * 0x100000001B3 % 2**64
    return max(h, 1)


def _place(run):
    """Directory of a run, prefix of its files, and its marker opened; None while it has not been begun
    (docs/plugin-contract.md)."""
    uid = os.getuid()
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    first = os.path.join(runtime, "cz") if os.path.isdir(runtime) else os.path.join(_tmp(), f"cz-{uid}")
    for base in [first] + [f"{first}-{i}" for i in range(1, 10)]:
        try:
            found = os.lstat(base)
        except OSError:
            continue
        # The first that is a directory of this user, no link, and for nobody else to write.
        if stat.S_ISDIR(found.st_mode) and found.st_uid == uid and not found.st_mode & 0o022:
            break
    else:
        return None
    directory = os.path.join(base, run)
    try:
        marker = os.open(os.path.join(directory, _MARKER), os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    instance = os.read(marker, 9).decode(errors="replace")
    if not re.fullmatch("[0-9a-f]{8}", instance):
        os.close(marker)
        return None
    return directory, f"cz_{uid}_{run}_{instance}_", marker


def _tmp():
    return os.environ.get("TMPDIR") or "/tmp"


def _alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as line:
            return line.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


class Session:
    """One attachment to a run. Once there is one, the world counts on an answer to every step."""

    def __init__(self, run=None, controller=None, attach_timeout=30.0):
        run = run or os.environ.get("CZ_RUN")
        controller = controller or os.environ.get("CZ_CONTROLLER")
        if not run or not controller:
            raise Error(
                "CZ_RUN or CZ_CONTROLLER is not set; start the program with `cz run --controller`, or set both"
            )
        deadline = time.monotonic() + attach_timeout
        late = Error(f"no world of run {run} answered within {attach_timeout} s")
        iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
        # A node in a space nobody has begun would leave a directory behind.
        while (place := _place(run)) is None:
            _pause(deadline, late)
        directory, prefix, self._marker = place
        # Held until the end: it says that somebody is in the run.
        fcntl.flock(self._marker, fcntl.LOCK_SH)
        config = iceoryx2.config.default()
        config.global_cfg.root_path = iceoryx2.Path.new(directory)
        config.global_cfg.prefix = iceoryx2.FileName.new(prefix)
        self._directory, self._prefix = directory, prefix
        self._node = (
            iceoryx2.NodeBuilder.new()
            .config(config)
            .signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled)
            .create(iceoryx2.ServiceType.Ipc)
        )
        while True:
            try:
                requests = self._service(s.SERVICE_ATTACH, s.AttachRequest, None)
                replies = self._service(s.SERVICE_ATTACH_REPLY, iceoryx2.Slice[ctypes.c_uint8], s.AttachReply)
                break
            except iceoryx2.PublishSubscribeOpenError as error:
                if "DoesNotExist" not in str(error) and "Hangs" not in str(error):
                    raise Error(f"cannot open the attach services: {error}") from error
                _pause(deadline, late)
        self._replies = replies.subscriber_builder().create()
        self._requests = requests.publisher_builder().create()
        request = s.AttachRequest(
            instance=random.SystemRandom().getrandbits(64),
            schema_hash=s.SCHEMA_HASH,
            scenario_hash=s.ANY_SCENARIO,
            controller=name_hash(controller),
            process_id=os.getpid(),
            role=s.ROLE_CONTROLLER,
            wanted_index=s.ANY_INDEX,
            phase=s.ATTACH_JOIN,
        )
        reply, data = self._exchange(request, deadline, late)
        if reply.status != s.ATTACH_ACCEPTED:
            raise Error(f"the world refused controller {controller}: {data.decode()}")
        self.reply = reply
        self.run = Run(data, reply.index)
        # The services are opened only now, when both sides are known to mean the same by them.
        self._states = self._service_of(s.SERVICE_STATE, s.VehicleState).subscriber_builder().create()
        self._coordination = self._service_of(s.SERVICE_COORDINATION, s.Assignment).subscriber_builder().create()
        self._commands = (
            self._service_of(s.SERVICE_COMMAND, s.VehicleCommand)
            .publisher_builder()
            .initial_max_slice_len(64)
            .allocation_strategy(iceoryx2.AllocationStrategy.PowerOfTwo)
            .max_loaned_samples(1)
            .create()
        )
        request.phase = s.ATTACH_READY
        request.index = reply.index
        self._exchange(request, deadline, late)
        self._next_step = reply.first_step
        self._state = None
        self._missing = 0
        self._assignments = {zone: [] for zone in self.run.own_zones}
        self._partners = {}

    def _service(self, name, record, header):
        builder = self._node.service_builder(iceoryx2.ServiceName.new(name)).publish_subscribe(record)
        return (builder if header is None else builder.user_header(header)).open()

    def _service_of(self, name, record):
        return self._service(name, iceoryx2.Slice[record], s.FrameHeader)

    def _exchange(self, request, deadline, late):
        repeat_at = 0.0
        while True:
            if time.monotonic() >= repeat_at:
                self._requests.send_copy(request)
                repeat_at = time.monotonic() + 0.1
            while (sample := self._replies.receive()) is not None:
                header = sample.user_header().contents
                if header.instance == request.instance:
                    reply = s.AttachReply.from_buffer_copy(header)
                    return reply, bytes(s.records(sample, ctypes.c_uint8))
            _pause(deadline, late)

    def wait(self, timeout=None):
        """Waits for a step: True when there is one to be answered, False at the end of the run.

        Raises `TimeoutError` when nothing came for `timeout` seconds.
        """
        if self._state is not None and not self._missing:
            return True
        start = checked = time.monotonic()
        polls = 0
        while True:
            ready = self._poll()
            if ready is not None:
                return ready
            polls += 1
            if polls % 16:
                os.sched_yield()
                continue
            now = time.monotonic()
            if timeout is not None and now - start >= timeout:
                raise TimeoutError(f"nothing came for {timeout} s")
            if now - checked >= 0.05:
                checked = now
                if not _alive(self.reply.world_process_id) and (ready := self._poll()) is None:
                    raise Error(f"the world (process {self.reply.world_process_id}) has ended")
            if now - start >= _BUSY_S:
                time.sleep(_NAP_S)

    def _poll(self):
        if self._state is None:
            sample = self._states.receive()
            if sample is None:
                return None
            header = sample.user_header().contents
            self._check(header, s.ROLE_WORLD)
            if header.flags & s.FLAG_END_OF_RUN:
                return False
            self._state = sample
            self._missing = header.coordinators_acting
            self._changed = set()
        while self._missing:
            sample = self._coordination.receive()
            if sample is None:
                return None
            header = sample.user_header().contents
            self._check(header, s.ROLE_COORDINATOR)
            for record in s.records(sample, s.Assignment):
                if record.zone in self._assignments:
                    if record.zone not in self._changed:
                        self._changed.add(record.zone)
                        self._assignments[record.zone] = []
                    self._assignments[record.zone].append(s.Assignment.from_buffer_copy(record))
            self._missing &= ~(1 << header.sender_index)
        return True

    def _check(self, header, role):
        for field, expected in (
            ("schema_hash", s.SCHEMA_HASH),
            ("run_id", self.reply.run_id),
            ("sender_role", role),
            ("step", self._next_step),
        ):
            found = getattr(header, field)
            if found != expected:
                raise Error(f"step {self._next_step}: a frame has {field} = {found}, expected {expected}")

    def answer(self, controller):
        """Answers the step: calls `controller(view)` for each of its zones and sends what it returns."""
        sample = self._state
        if sample is None or self._missing:
            raise Error("there is no step to answer; wait for one first")
        header = sample.user_header().contents
        states = s.records(sample, s.VehicleState)
        zones = self._own(states)
        count = sum(len(own) for _, _, own in zones)
        loan = self._commands.loan_slice_uninit(count)
        out = loan.user_header().contents
        ctypes.memset(ctypes.addressof(out), 0, ctypes.sizeof(out))
        out.run_id = self.reply.run_id
        out.schema_hash = s.SCHEMA_HASH
        out.step = self._next_step
        out.time_ns = header.time_ns
        out.sender_role = s.ROLE_CONTROLLER
        out.sender_index = self.reply.index
        out.generation = self.reply.generation
        out.record_count = count
        commands = s.records(loan, s.VehicleCommand)
        if count:
            ctypes.memset(loan.payload_ptr, 0, ctypes.sizeof(commands))
        frame = as_array(states) if len(states) else states
        records = as_array(commands) if count else commands
        at = 0
        for zone, (start, end), own in zones:
            if not own:
                continue
            if zone in self._changed or zone not in self._partners:
                local = [i - start for i in own]
                self._partners[zone] = Partners(states[start:end], local, self._assignments[zone])
            contiguous = own[-1] - own[0] + 1 == len(own)
            places = slice(own[0] - start, own[-1] + 1 - start) if contiguous else [i - start for i in own]
            part = records[at : at + len(own)]
            for k, i in enumerate(own):
                command = commands[at + k]
                command.vehicle = states[i].vehicle
                command.zone = zone
                command.mode = s.MODE_OCBF
            name = self.run.zone_names[zone]
            partners = self._partners[zone]
            view = ZoneView(self.run, zone, name, header, frame[start:end], places, partners, part)
            u = controller(view)
            if len(u) != len(own):
                raise Error(f"step {self._next_step}: {len(u)} accelerations for {len(own)} vehicles")
            for k in range(len(own)):
                commands[at + k].u_mps2 = u[k]
            at += len(own)
        # Every reference into the frames goes before they do.
        view = part = records = frame = commands = states = out = header = None
        reached = loan.assume_init().send()
        self._state = None
        if reached == 0:
            raise Error("the world has gone")
        self._next_step += 1

    def close(self):
        """Leaves the run. Whoever leaves last removes what iceoryx2 leaves behind."""
        if self._node is None:
            return
        self._state = self._states = self._coordination = self._commands = None
        self._replies = self._requests = self._node = None
        try:
            # Whoever is in the run holds this lock too.
            fcntl.flock(self._marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._remove()
        except OSError:
            pass
        finally:
            os.close(self._marker)

    def _remove(self):
        for name in os.listdir("/dev/shm"):
            if name.startswith(self._prefix):
                _forget(os.remove, os.path.join("/dev/shm", name))
        # The marker last, by which the directory is known for a run's.
        for name in os.listdir(self._directory):
            if name != _MARKER:
                shutil.rmtree(os.path.join(self._directory, name), ignore_errors=True)
        _forget(os.remove, os.path.join(self._directory, _MARKER))
        _forget(os.rmdir, self._directory)
        # Fails, as it should, while another run has its directory there.
        _forget(os.rmdir, os.path.dirname(self._directory))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _own(self, states):
        """Per own zone: its slice of the frame, and the places of the vehicles to be commanded."""
        zones = {zone: [None, 0, []] for zone in self.run.own_zones}
        drives = self.run.own
        for i, state in enumerate(states):
            entry = zones.get(state.zone)
            if entry is None:
                continue
            if entry[0] is None:
                entry[0] = i
            entry[1] = i + 1
            if not state.flags & s.STATE_LEFT and (state.zone, state.path) in drives:
                entry[2].append(i)
        return [(zone, (start or 0, end), own) for zone, (start, end, own) in zones.items()]


def _forget(remove, path):
    try:
        remove(path)
    except OSError:
        pass


def _pause(deadline, late):
    if time.monotonic() >= deadline:
        raise late
    time.sleep(0.002)


def run(controller, run=None, name=None, attach_timeout=30.0):
    """Joins a run and answers every step to its end.

    `controller` is a function from a `ZoneView` to one acceleration per vehicle (m/s^2). If it has a method
    `attached`, that is called first with the `Run`. Run and controller name come from the environment
    (`CZ_RUN`, `CZ_CONTROLLER`) unless given.
    """
    with Session(run, name, attach_timeout) as session:
        if hasattr(controller, "attached"):
            controller.attached(session.run)
        while session.wait():
            session.answer(controller)
