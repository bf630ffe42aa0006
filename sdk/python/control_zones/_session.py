"""Joining a run and answering its steps."""

from __future__ import annotations

import ctypes
import dataclasses
import fcntl
import os
import random
import re
import shutil
import stat
import sys
import time
import typing

import iceoryx2

from . import _schemas as s
from ._view import Feedback, Partners, ZoneView, feedback_of, frozen, structured

if typing.TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    #: One acceleration per vehicle of the view, m/s^2.
    Controller = Callable[[ZoneView], Iterable[float]]
    #: The same for all zones at once.
    JointController = Callable[[list[ZoneView]], Iterable[Iterable[float]]]
    Record = typing.TypeVar("Record", bound=ctypes.Structure)

#: Seconds of polling before sleeping between polls.
_BUSY_S = 0.002
_NAP_S = 0.0001
#: The file in a run's directory by which it is known.
_MARKER = ".cz-run"
#: Seconds after which an unanswered request is repeated.
_REPEAT_S = 0.1
#: Frames looked at in one go; after that whoever waits looks at its clock.
_AT_ONCE = 16
#: Accounts of refused frames are kept for this many senders; the rest share one.
_MAX_ACCOUNTS = 16
#: In the place of a fault: the frame is of somebody who had the place before.
_LATE = "late"


class Error(Exception):
    """Why a controller cannot go on."""


@dataclasses.dataclass
class Summary:
    """What a run has been for a controller, as the controller saw it."""

    #: Step of the last state seen, and simulated time of it, s.
    step: int = 0
    time: float = 0.0
    #: Steps answered.
    answered: int = 0
    #: Steps that passed without this controller between its answers.
    skipped: int = 0
    #: Of the states seen, those before which the world had put something in for a controller that was late.
    missed: int = 0
    #: Answers that the world refused, as far as it said so: once in a step.
    refused: int = 0


class Run:
    """The run a controller has joined.

    Attributes:
        spec: `schemas.RunSpec`: step, limits, distances, gains.
        paths: list of `schemas.PathSpec`; names: `ZONE.PATH` of each.
        kinds: list of `schemas.KindSpec`, by `VehicleState.kind`.
        index: own index among the controller processes.
        lengths: `lengths[zone][path]`, m; own: set of (zone, path) this controller drives.
    """

    def __init__(self, data: bytes, index: int) -> None:
        size = ctypes.sizeof(s.RunSpec)
        if len(data) < size:
            raise Error(f"the world's reply has {len(data)} bytes, which is not a run specification")
        self.spec = s.RunSpec.from_buffer_copy(data)
        self.index = index
        self.paths: list[s.PathSpec] = []
        for _ in range(self.spec.paths):
            self.paths.append(s.PathSpec.from_buffer_copy(data, size))
            size += ctypes.sizeof(s.PathSpec)
        self.kinds: list[s.KindSpec] = []
        for _ in range(self.spec.kinds):
            self.kinds.append(s.KindSpec.from_buffer_copy(data, size))
            size += ctypes.sizeof(s.KindSpec)
        self.names = bytes(data[size:]).decode().splitlines()
        self.lengths: dict[int, dict[int, float]] = {}
        self.zone_names: dict[int, str] = {}
        for a, name in zip(self.paths, self.names):
            self.lengths.setdefault(a.zone, {})[a.path] = a.length_m
            self.zone_names[a.zone] = name.split(".")[0]
        self.own = {(a.zone, a.path) for a in self.paths if a.flags & s.PATH_OWN}
        self.own_zones = sorted({zone for zone, _ in self.own})


def name_hash(name: str) -> int:
    """FNV-1a, 64 bits: how a controller's name travels."""
    h = 0xCBF29CE484222325
    for byte in name.encode():
        h = (h ^ byte) * 0x100000001B3 % 2**64
    return max(h, 1)


def _place(run: str) -> tuple[str, str, int] | None:
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


def _tmp() -> str:
    return os.environ.get("TMPDIR") or "/tmp"


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as line:
            return line.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


class Session:
    """One attachment to a run. Once there is one, the world counts on an answer to every step."""

    def __init__(
        self, run: str | None = None, controller: str | None = None, attach_timeout: float = 30.0
    ) -> None:
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
        self._joined: bytes | None = None
        reply, data = self._exchange(request, deadline, late)
        if reply.status != s.ATTACH_ACCEPTED:
            raise Error(f"the world refused controller {controller}: {data.decode()}")
        self.reply = reply
        self.run = Run(data, reply.index)
        self._joined = data
        # The services are opened only now, when both sides are known to mean the same by them.
        self._states = self._service_of(s.SERVICE_STATE, s.VehicleState).subscriber_builder().create()
        self._coordination = self._service_of(s.SERVICE_COORDINATION, s.Assignment).subscriber_builder().create()
        self._members = self._service_of(s.SERVICE_MEMBERS, s.Member).subscriber_builder().create()
        feedback = f"{s.SERVICE_FEEDBACK_PREFIX}{reply.index}"
        self._feedback = self._service_of(feedback, s.Feedback).subscriber_builder().create()
        self._commands = (
            self._service_of(s.SERVICE_COMMAND, s.VehicleCommand)
            .publisher_builder()
            .initial_max_slice_len(64)
            .allocation_strategy(iceoryx2.AllocationStrategy.PowerOfTwo)
            # A world that has gone on may have no room for late answers, and does not want them.
            .backpressure_strategy(iceoryx2.BackpressureStrategy.DiscardData)
            .max_loaned_samples(1)
            .create()
        )
        request.phase = s.ATTACH_READY
        request.index = reply.index
        self._request = request
        self._assignments: dict[int, list[s.Assignment]] = {zone: [] for zone in self.run.own_zones}
        self._partners: dict[int, Partners] = {}
        # The first step whose coordination is not in force yet.
        self._next_step = 0
        # Behind the last step that has been answered: a state may come again, for somebody who has just joined.
        self._open_from = 0
        #: What the run has been so far, as this controller saw it.
        self.summary = Summary()
        # Accelerations of the last answer, by vehicle.
        self._commanded: dict[int, float] = {}
        # What the shield found of commands, by step and vehicle, and answers that were refused since the last one.
        self._bounded: dict[int, dict[int, Feedback]] = {}
        self._refusals: list[Feedback] = []
        self._ask_again_at: float | None = None
        self._state: _State | None = None
        self._complete = False
        # Sending ends that have proved to be the world's, by role and service.
        self._world_ports: set[int] = set()
        # Process, generation and proved sending end of each coordinator, as the world says.
        self._coordinators: dict[int, tuple[int, int, int | None]] = {}
        self._refused: dict[tuple[int, int, int], tuple[str, int, str]] = {}
        self._restore(*self._exchange(request, deadline, late))

    def _service(self, name: str, record: typing.Any, header: type[ctypes.Structure] | None) -> typing.Any:
        builder = self._node.service_builder(iceoryx2.ServiceName.new(name)).publish_subscribe(record)
        return (builder if header is None else builder.user_header(header)).open()

    def _service_of(self, name: str, record: type[ctypes.Structure]) -> typing.Any:
        return self._service(name, iceoryx2.Slice[record], s.FrameHeader)

    def _exchange(
        self, request: s.AttachRequest, deadline: float, late: Error
    ) -> tuple[s.AttachReply, bytes]:
        repeat_at = 0.0
        while True:
            if time.monotonic() >= repeat_at:
                self._requests.send_copy(request)
                repeat_at = time.monotonic() + _REPEAT_S
            found = self._reply(request.instance)
            if found is not None:
                return found
            _pause(deadline, late)

    def _reply(self, instance: int) -> tuple[s.AttachReply, bytes] | None:
        """The next reply to this controller, and the bytes behind it, if one has come."""
        while (sample := self._replies.receive()) is not None:
            reply = s.AttachReply.from_buffer_copy(sample.user_header().contents)
            data = bytes(s.records(sample, ctypes.c_uint8))
            # Whoever had to repeat the first request gets its reply again, sooner or later.
            if reply.instance == instance and data != self._joined:
                return reply, data
        return None

    def _restore(self, reply: s.AttachReply, data: bytes) -> None:
        """Takes the assignments in force from a reply."""
        if reply.status != s.ATTACH_ACCEPTED:
            raise Error(f"the world refused this controller: {data.decode(errors='replace')}")
        count, rest = divmod(len(data), ctypes.sizeof(s.Assignment))
        if rest:
            raise Error(f"the world's reply has {len(data)} bytes, which are no assignments")
        self._next_step = reply.first_step
        self._assignments = {zone: [] for zone in self.run.own_zones}
        self._partners = {}
        self._coordinate((s.Assignment * count).from_buffer_copy(data))

    def _coordinate(self, records: Iterable[s.Assignment]) -> None:
        """Replaces the coordination of the zones that these are for."""
        changed: dict[int, list[s.Assignment]] = {}
        for record in records:
            if record.zone in self._assignments:
                changed.setdefault(record.zone, []).append(record)
        for zone, assignments in changed.items():
            self._assignments[zone] = assignments
            self._partners.pop(zone, None)

    def wait(self, timeout: float | None = None) -> bool:
        """Waits for a step: True when there is one to be answered, False at the end of the run.

        Raises `TimeoutError` when nothing came for `timeout` seconds.
        """
        if self._complete:
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
                # Of a world that has ended nothing more can be had.
                self._take_feedback()
                if not _alive(self.reply.world_process_id):
                    # Its last frame may have come in the meantime.
                    if (ready := self._poll()) is not None:
                        return ready
                    raise self._world_gone()
            if now - start >= _BUSY_S:
                time.sleep(_NAP_S)

    def _poll(self) -> bool | None:
        """Does what can be done now: True for a step to be answered, False at the end, None to go on waiting."""
        if self._ask_again_at is not None:
            found = self._reply(self._request.instance)
            if found is not None:
                self._ask_again_at = None
                self._restore(*found)
        if self._take_states():
            return False
        state = self._state
        if state is None:
            return None
        step = state.header.step
        if step > self._next_step:
            # Steps have passed without this controller, and with them perhaps coordination.
            self._catch_up()
            return None
        if step == self._next_step:
            self._take_coordination(state)
            if state.missing:
                return None
        # Otherwise its coordination is in force already.
        self._next_step = max(self._next_step, step + 1)
        self.summary.skipped += self._skipped(state.header)
        self._saw(state.header)
        self._take_feedback()
        for old in [told for told in self._bounded if told + 1 < step]:
            del self._bounded[old]
        self._complete = True
        return True

    def _saw(self, header: s.FrameHeader) -> None:
        """Notes a state for the summary."""
        self.summary.step = header.step
        self.summary.time = header.time_ns * 1e-9
        self.summary.missed += bool(header.flags & s.FLAG_MISSED)

    def _skipped(self, header: s.FrameHeader) -> int:
        """Steps that have passed without this controller since its last answer."""
        return max(0, header.step - self._open_from) if self.summary.answered else 0

    def _take_states(self) -> bool:
        """Takes the newest state; an older one would be answered too late. Whether the run is over."""
        for _ in range(_AT_ONCE):
            sample = self._states.receive()
            if sample is None:
                break
            # Copied before it is judged: what was judged is what is used, and may be kept.
            header = s.FrameHeader.from_buffer_copy(sample.user_header().contents)
            fault = self._not_the_world(header, sample)
            if fault is not None:
                self._refuse(header, sample, fault)
                continue
            if header.flags & s.FLAG_END_OF_RUN:
                self._saw(header)
                return True
            # The same may come again, when of its coordination some has been taken.
            is_newer = self._state is None or header.step > self._state.header.step
            # Of the step before the next one, the coordination is known: it may still be answered.
            if is_newer and header.step >= self._open_from and header.step + 1 >= self._next_step:
                self._state = _State(header, sample)
        if self._state is not None and self._state.header.step + 1 < self._next_step:
            self._state = None
        return False

    def _take_feedback(self) -> None:
        """Takes what the world has said of the answers; what it said of the last one came before the state that followed."""
        for _ in range(_AT_ONCE):
            sample = self._feedback.receive()
            if sample is None:
                break
            header = s.FrameHeader.from_buffer_copy(sample.user_header().contents)
            records = _copied(sample, s.Feedback)
            fault = self._not_the_world(header, sample)
            if fault is not None:
                self._refuse(header, sample, fault)
                continue
            for told in map(feedback_of, records):
                if told.rule == s.RULE_NONE:
                    self._bounded.setdefault(told.step, {})[told.vehicle] = told
                else:
                    self.summary.refused += 1
                    self._refusals.append(told)

    def _world_gone(self) -> Error:
        """Why a run is over that has had no end."""
        refused = f"; it had refused an answer: {self._refusals[-1]}" if self._refusals else ""
        return Error(f"the world (process {self.reply.world_process_id}) has ended without an end of the run{refused}")

    def _take_coordination(self, state: _State) -> None:
        """Takes coordination of the step at hand, as far as it has come."""
        for _ in range(_AT_ONCE):
            if not state.missing:
                break
            sample = self._coordination.receive()
            if sample is None:
                break
            header = s.FrameHeader.from_buffer_copy(sample.user_header().contents)
            records = _copied(sample, s.Assignment)
            fault = self._no_coordinator(header, sample)
            if fault is _LATE:
                continue
            foreign = next((r.zone for r in records if r.zone >= self.run.spec.zones), None)
            if fault is None and foreign is not None:
                fault = f"there is no zone {foreign}"
            if fault is not None:
                self._refuse(header, sample, fault)
            # Otherwise it is late, or of a step to come, or has come twice.
            elif header.step == self._next_step and state.missing >> header.sender_index & 1:
                self._coordinate(records)
                state.missing &= ~(1 << header.sender_index)

    def _catch_up(self) -> None:
        """Asks for the coordination in force, and again while no answer comes."""
        now = time.monotonic()
        if self._ask_again_at is not None:
            if now < self._ask_again_at:
                return
        else:
            # What lies here is older than what the answer will say; it would only be in the way.
            for _ in range(_AT_ONCE):
                if self._coordination.receive() is None:
                    break
            while self._reply(self._request.instance) is not None:
                pass
        request = s.AttachRequest.from_buffer_copy(self._request)
        request.phase = s.ATTACH_RESTORE
        self._requests.send_copy(request)
        self._ask_again_at = now + _REPEAT_S

    def _not_the_world(self, header: s.FrameHeader, sample: typing.Any) -> str | None:
        """Why a frame is not the world's, if it is not."""
        fault = self._fault(header, sample, s.ROLE_WORLD)
        if fault is None and (header.sender_index, header.generation) != (0, 0):
            fault = "its sender_index or generation is not the world's"
        if fault is None and (port := sample.header.publisher_id.value) not in self._world_ports:
            if (process := _process_of(sample)) != self.reply.world_process_id:
                return f"it was sent by process {process}; the world is {self.reply.world_process_id}"
            self._world_ports.add(port)
        return fault

    def _no_coordinator(self, header: s.FrameHeader, sample: typing.Any) -> str | None:
        """Why a frame is not one of a coordinator of the run, if it is not."""
        fault = self._fault(header, sample, s.ROLE_COORDINATOR)
        if fault is not None:
            return fault
        port = sample.header.publisher_id.value
        member = self._coordinators.get(header.sender_index)
        if member is None or member[2] != port:
            self._listen()
            member = self._coordinators.get(header.sender_index)
        if member is None:
            return f"the run has no coordinator {header.sender_index}"
        process, generation, known = member
        if header.generation < generation:
            # What one that has died left; its successor sends the same again.
            return _LATE
        if header.generation > generation:
            return f"it has generation = {header.generation}, expected {generation}"
        if known != port:
            if (found := _process_of(sample)) != process:
                return f"it was sent by process {found}; coordinator {header.sender_index} is {process}"
            self._coordinators[header.sender_index] = process, generation, port
        return None

    def _listen(self) -> None:
        """Takes what the world has said of who has which place."""
        while (sample := self._members.receive()) is not None:
            header = s.FrameHeader.from_buffer_copy(sample.user_header().contents)
            records = _copied(sample, s.Member)
            fault = self._not_the_world(header, sample)
            if fault is not None:
                self._refuse(header, sample, fault)
                continue
            for member in records:
                known = self._coordinators.get(member.index, (None, None))
                if member.role == s.ROLE_COORDINATOR and known[:2] != (member.process_id, member.generation):
                    self._coordinators[member.index] = member.process_id, member.generation, None

    def _fault(self, header: s.FrameHeader, sample: typing.Any, role: int) -> str | None:
        """What is wrong with the header of a frame, if anything is."""
        for field, expected in (
            ("schema_hash", s.SCHEMA_HASH),
            ("run_id", self.reply.run_id),
            ("sender_role", role),
            ("record_count", sample.header.number_of_elements),
        ):
            found = getattr(header, field)
            if found != expected:
                return f"it has {field} = {found}, expected {expected}"
        return None

    def _refuse(self, header: s.FrameHeader, sample: typing.Any, fault: str) -> None:
        key = header.sender_role, header.sender_index, sample.header.publisher_id.value
        if key not in self._refused and len(self._refused) >= _MAX_ACCOUNTS:
            key = next(reversed(self._refused))
        sender, frames, _ = self._refused.get(key) or (_claim(header, _process_of(sample)), 0, None)
        self._refused[key] = sender, frames + 1, fault

    def refused(self) -> list[str]:
        """What was refused, in words: one line per sender."""
        return [f"refused {n} frames of {sender}; the last: {last}" for sender, n, last in self._refused.values()]

    @property
    def step(self) -> int | None:
        """Number of the step to be answered; None while there is none."""
        return self._state.header.step if self._state is not None and self._complete else None

    def answer(self, controller: Controller | JointController, joint: bool = False) -> None:
        """Answers the step: calls `controller(view)` for each of its zones and sends what it returns; if `joint`, calls
        `controller(views)` once, which returns as many lists of accelerations.

        An answer that comes too late is dropped: the next step is another chance.
        """
        if self._state is None or not self._complete:
            raise Error("there is no step to answer; wait for one first")
        header, states, frame = self._state.header, self._state.records, self._state.frame
        zones = self._own(states)
        count = sum(len(own) for _, _, own in zones)
        commands = (s.VehicleCommand * count)()
        records = structured(commands)
        views: list[ZoneView] = []
        at = 0
        for zone, (start, end), own in zones:
            if not own:
                continue
            if zone not in self._partners:
                local = [i - start for i in own]
                self._partners[zone] = Partners(states[start:end], local, self._assignments[zone])
            contiguous = own[-1] - own[0] + 1 == len(own)
            places: slice | list[int]
            places = slice(own[0] - start, own[-1] + 1 - start) if contiguous else [i - start for i in own]
            part = records[at : at + len(own)]
            for k, i in enumerate(own):
                command = commands[at + k]
                command.vehicle = states[i].vehicle
                command.zone = zone
                command.mode = s.MODE_OCBF
            name = self.run.zone_names[zone]
            partners = self._partners[zone]
            # Of an older answer nothing says what was applied.
            is_answered = header.step == self._open_from
            commanded = self._commanded if is_answered else None
            bounded = self._bounded.get(header.step - 1) if is_answered else None
            skipped = self._skipped(header)
            records_ = frozen(frame[start:end])
            views.append(
                ZoneView(
                    self.run, zone, name, header, records_, places, partners, part, frozen(frame), skipped, commanded,
                    bounded, self._refusals,
                )
            )
            at += len(own)
        at = 0
        for view, accelerations in zip(views, _decided(controller, views, joint, header.step)):
            for k, u in enumerate(accelerations):
                commands[at + k].u_mps2 = u
            at += len(view)
        self._commanded = {command.vehicle: command.u_mps2 for command in commands}
        self._send(header, commands)

    def _send(self, header: s.FrameHeader, commands: ctypes.Array[s.VehicleCommand]) -> None:
        # Lent only now, so that a controller that fails leaves nothing on loan.
        loan = self._commands.loan_slice_uninit(len(commands))
        out = loan.user_header().contents
        ctypes.memset(ctypes.addressof(out), 0, ctypes.sizeof(out))
        out.run_id = self.reply.run_id
        out.schema_hash = s.SCHEMA_HASH
        out.step = header.step
        out.time_ns = header.time_ns
        out.sender_role = s.ROLE_CONTROLLER
        out.sender_index = self.reply.index
        out.generation = self.reply.generation
        out.record_count = len(commands)
        if len(commands):
            ctypes.memmove(loan.payload_ptr, commands, ctypes.sizeof(commands))
        out = None
        reached = loan.assume_init().send()
        self._open_from = header.step + 1
        # Another list: the views may be kept.
        self._refusals = []
        self.summary.answered += 1
        self._state = None
        self._complete = False
        # Nobody has room for an answer that is too late, and nobody is there once the world has gone.
        if reached == 0 and not _alive(self.reply.world_process_id):
            raise self._world_gone()

    def close(self) -> None:
        """Leaves the run. Whoever leaves last removes what iceoryx2 leaves behind."""
        if self._node is None:
            return
        # There is no summary in which it could stand.
        for line in self.refused():
            print(line, file=sys.stderr)
        self._state = self._states = self._coordination = self._members = self._feedback = self._commands = None
        self._replies = self._requests = self._node = None
        try:
            # Whoever is in the run holds this lock too.
            fcntl.flock(self._marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._remove()
        except OSError:
            pass
        finally:
            os.close(self._marker)

    def _remove(self) -> None:
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

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _own(self, states: Iterable[s.VehicleState]) -> list[tuple[int, tuple[int, int], list[int]]]:
        """Per own zone: its slice of the frame, and the places of the vehicles to be commanded."""
        slices: dict[int, tuple[int, int]] = {zone: (0, 0) for zone in self.run.own_zones}
        places: dict[int, list[int]] = {zone: [] for zone in self.run.own_zones}
        drives = self.run.own
        for i, state in enumerate(states):
            known = slices.get(state.zone)
            if known is None:
                continue
            start, end = known
            slices[state.zone] = (start if end else i, i + 1)
            if not state.flags & (s.STATE_LEFT | s.STATE_HUMAN) and (state.zone, state.path) in drives:
                places[state.zone].append(i)
        return [(zone, found, places[zone]) for zone, found in slices.items()]


class _State:
    """A state to be answered: copies, so that nothing of it lies where others write."""

    def __init__(self, header: s.FrameHeader, sample: typing.Any) -> None:
        self.header = header
        self.records = _copied(sample, s.VehicleState)
        self.frame = structured(self.records)
        # Coordinators whose frame of this step is still to come.
        self.missing: int = header.coordinators_acting


def _copied(sample: typing.Any, record: type[Record]) -> ctypes.Array[Record]:
    size = sample.header.number_of_elements * ctypes.sizeof(record)
    data = ctypes.string_at(sample.payload_ptr, size)
    array: type[ctypes.Array[Record]] = record * sample.header.number_of_elements
    return array.from_buffer_copy(data)


def _process_of(sample: typing.Any) -> int:
    """The process of a frame's sender, as the transport names it."""
    process: int = sample.header.node_id.pid(iceoryx2.ServiceType.Ipc)
    return process


def _claim(header: s.FrameHeader, process: int) -> str:
    role = {s.ROLE_WORLD: "world", s.ROLE_COORDINATOR: "coordinator", s.ROLE_CONTROLLER: "controller"}
    name = role.get(header.sender_role, f"a sender of unknown role {header.sender_role},")
    return f"{name} {header.sender_index} (process {process})"


def _decided(
    controller: typing.Any, views: list[ZoneView], joint: bool, step: int
) -> typing.Iterator[list[float]]:
    """What the controller decides for each zone, as numbers; if it cannot be, what to do about it."""
    if not joint:
        for view in views:
            where = f"step {view.step}, zone {view.name}"
            yield _accelerations(_called(controller, view, where), where, len(view))
        return
    where = f"step {step}"
    all_ = _called(controller, views, where)
    expected = f"expected {len(views)} lists of accelerations, one per zone"
    try:
        lists = list(all_)
    except TypeError as error:
        raise Error(f"{where}: the controller returned {_kind(all_)}; {expected}") from error
    if len(lists) != len(views):
        raise Error(f"{where}: the controller returned {len(lists)} lists; {expected}")
    for view, u in zip(views, lists):
        yield _accelerations(u, f"{where}, zone {view.name}", len(view))


def _called(controller: typing.Any, shown: ZoneView | list[ZoneView], where: str) -> typing.Any:
    try:
        return controller(shown)
    except ValueError as error:
        if "read-only" not in str(error):
            raise
        raise Error(
            f"{where}: the arrays of a zone are read-only; make one of your own, such as `err = zone.v - 15` "
            "or `v = zone.v.copy()`"
        ) from error


def _kind(value: object) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def _accelerations(u: typing.Any, where: str, count: int) -> list[float]:
    expected = f"expected {count} accelerations, one per vehicle"
    try:
        numbers = [float(number) for number in u]
    except (TypeError, ValueError) as error:
        raise Error(f"{where}: the controller returned {_kind(u)}; {expected}") from error
    if len(numbers) != count:
        raise Error(f"{where}: the controller returned {len(numbers)} accelerations; {expected}")
    return numbers


def _forget(remove: Callable[[str], None], path: str) -> None:
    try:
        remove(path)
    except OSError:
        pass


def _pause(deadline: float, late: Error) -> None:
    if time.monotonic() >= deadline:
        raise late
    time.sleep(0.002)


def run(
    controller: Controller | JointController,
    run: str | None = None,
    name: str | None = None,
    attach_timeout: float = 30.0,
    joint: bool = False,
) -> None:
    """Joins a run and answers every step to its end.

    `controller` is a function from a `ZoneView` to one acceleration per vehicle (m/s^2); if `joint`, from a list of them,
    one per zone with vehicles, to as many lists. If it has a method `attached`, that is called first with the `Run`; if it
    has `on_end`, that is called with the `Summary` when the run is over. Run and controller name come from the environment
    (`CZ_RUN`, `CZ_CONTROLLER`) unless given.
    """
    with Session(run, name, attach_timeout) as session:
        if hasattr(controller, "attached"):
            controller.attached(session.run)
        while session.wait():
            session.answer(controller, joint)
        if hasattr(controller, "on_end"):
            controller.on_end(session.summary)
