"""A scenario of our own as a SUMO network, and SUMO as its world."""

from __future__ import annotations

import math
import os
import typing
import xml.etree.ElementTree as ElementTree

import libsumo

from ..world import GONE, Admitted, Newcomer, Traffic
from .network import Place, cut, length
from .simulation import SUMOS, THROUGH, Car, Simulation, is_automated, make

if typing.TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

#: Of ways that are one lane up to their merge, so much is within the junction, m.
MERGE_M = 5.0
#: What is beyond the last zone, m.
BEYOND_M = 400.0
#: Where ways cross: how far behind the first conflict point SUMO's junction begins, so that who waits at the point is not in it; over how much
#: ways part before it, and how far it goes on behind the merge that a way ends at, so that there is some of it left, m.
INTO_M, PARTS_M, ONTO_M = 0.01, 1.0, 3.0
#: Less than this from where ways part to their first conflict points is no road of its own; entrances nearer to each other than this are lanes
#: of one leg, m.
LEAST_M, BESIDE_M = 5.0, 10.0
#: How far ways are from each other where they merge or part, m; over how much before a merge, and behind a parting, m.
APART_M, TAPER_M, PARTING_M = 4.0, 40.0, 15.0


def between(line: Sequence[Place], start: float, end: float) -> list[Place]:
    """What of a line is between two shares of its length."""
    behind = cut(line, start)
    return cut(behind[::-1], 1.0 - (end - start) / (1.0 - start))[::-1] if end < 1.0 else behind


def straightness(first: Sequence[Place], last: Sequence[Place]) -> float:
    """The cosine of the angle between the beginning of a way and its end."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = *first[:2], *last[-2:]
    return ((bx - ax) * (dx - cx) + (by - ay) * (dy - cy)) / (math.dist(first[0], first[1]) * math.dist(last[-2], last[-1]))


def aside(line: Sequence[Place], at_end: bool, left: Place, by_m: float, over_m: float) -> list[Place]:
    """A line moved aside at one of its ends, and less and less over so much of its length."""
    line = list(line) if at_end else list(line)[::-1]
    over_m = min(over_m, length(line))
    end = cut(line, 1.0 - over_m / length(line))
    before = [] if over_m >= length(line) - 1e-6 else between(line, 0.0, 1.0 - over_m / length(line))[:-1]
    parts, moved = math.ceil(over_m), []
    for part in range(parts + 1):
        share = part / parts
        x, y = cut(end, share)[0] if part < parts else end[-1]
        moved.append((x + share * by_m * left[0], y + share * by_m * left[1]))
    return [*before, *moved] if at_end else [*before, *moved][::-1]


def apart(shape: dict[str, typing.Any], drawn: Sequence[Sequence[Place]]) -> list[list[Place]]:
    """A zone's lines, side by side where they merge and where they part: bodies are in each other's way from a merge on, and until they
    have passed where ways part, so whoever waits at the one or behind the other stands in nobody's."""
    lines = [[(float(x), float(y)) for x, y in line] for line in drawn]
    paths = shape["paths"]
    merging = [{path["segments"][-1] for path in paths if path["exit"] == exit_} for exit_ in range(len(shape["exits"]))]
    inner = [path["segments"] for path in paths if len(path["segments"]) > 1]
    parting = [{way[1] for way in inner if way[0] == first} for first in sorted({way[0] for way in inner})]
    ways = [path["segments"] for path in paths]
    straight = {way[part]: straightness(lines[way[0]], lines[way[-1]]) for way in ways for part in (-1, min(1, len(way) - 1))}
    for group, at_end in [*((group, True) for group in merging), *((group, False) for group in parting)]:
        if len(group) < 2:
            continue
        over_m = TAPER_M if at_end else PARTING_M
        # Backwards from a merge, forwards from a parting.
        away = {segment: lines[segment][::-1] if at_end else lines[segment] for segment in group}
        far = {segment: cut(line, min(0.999, 0.5 * over_m / length(line)))[0] for segment, line in away.items()}
        x, y = (sum(far[segment][axis] - away[segment][0][axis] for segment in group) for axis in (0, 1))
        long_m = math.hypot(x, y) or 1.0
        left = (-y / long_m, x / long_m)
        # From the right to the left, as they are there.
        order = sorted(group, key=lambda segment: far[segment][0] * left[0] + far[segment][1] * left[1])
        # Where lanes lie beside each other whoever goes straight on stays on its own.
        stays = order.index(max(order, key=lambda segment: straight[segment])) if shape["crossings"] else 0.5 * (len(order) - 1)
        for place, segment in enumerate(order):
            if place != stays:
                lines[segment] = aside(lines[segment], at_end, left, APART_M * (place - stays), over_m)
    return lines


class Way(typing.NamedTuple):
    """A connection between lanes: edges, and which lane of each."""

    start: str
    end: str
    start_lane: int = 0
    end_lane: int = 0


def draw(path: str, roads: dict[str, Sequence[Place]], ways: dict[Way, Sequence[Place]]) -> None:
    """Puts lanes where the scenario has them: netconvert pulls roads together to the middle of their junction."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    lanes = {lane.get("id", ""): lane for lane in root.iter("lane")}
    onward = {
        Way(one.get("from", ""), one.get("to", ""), int(one.get("fromLane", "0")), int(one.get("toLane", "0"))): one.get("via")
        for one in root.iter("connection")
    }
    shapes = dict(roads)
    for way, line in ways.items():
        # A way may be several lanes: SUMO has drivers wait between them.
        chain, via = [], onward.get(way)
        while via:
            chain.append(via)
            edge, _, lane_of_it = via.rpartition("_")
            via = onward.get(way._replace(start=edge, start_lane=int(lane_of_it)))
        whole_m = sum(float(lanes[lane].get("length", 0.0)) for lane in chain)
        from_m = 0.0
        for lane in chain:
            to_m = from_m + float(lanes[lane].get("length", 0.0))
            shapes[lane] = between(line, from_m / whole_m, min(1.0, to_m / whole_m + 1e-9))
            from_m = to_m
    for name, line in shapes.items():
        lanes[name].set("shape", " ".join(f"{x:.3f},{y:.3f}" for x, y in line))
    tree.write(path)


class Leg(typing.NamedTuple):
    """Entrances beside each other where ways cross: from where ways part to SUMO's junction they are lanes of one road."""

    edge: str
    #: Its length with what is in the junction where ways part, m.
    length_m: float
    #: From the right to the left, the entrance that leads to each and the segment behind that.
    lanes: list[tuple[int, int]]

    def lane(self, inner: int) -> int:
        """The lane on which a segment begins."""
        return next(lane for lane, (_, of) in enumerate(self.lanes) if of == inner)


class Replica:
    """The network of a scenario as edges: one for each entrance, one for what is behind each last exit."""

    def __init__(self, described: dict[str, typing.Any]) -> None:
        self.network = described["scenario"]["network"]
        self.shapes = described["shapes"]
        self.v_max_mps = float(described["scenario"]["vehicle"]["v_max_mps"])
        #: By zone and entrance.
        self.legs = [{at: leg for leg in self.legs_of(zone) for at, _ in leg.lanes} for zone in range(len(self.shapes))]
        self.approaches = {leg.edge for zone in self.legs for leg in zone.values()}

    def entrance(self, zone: int, path: int) -> int:
        """The first segment of a path."""
        return int(self.network["zones"][zone]["paths"][path]["segments"][0])

    def inside_m(self, zone: int, segment: int) -> float:
        """How much of an entrance is within the junction, m."""
        paths = self.network["zones"][zone]["paths"]
        return MERGE_M if any(path["segments"] == [segment] for path in paths) else 0.0

    def first_m(self, zone: int, inner: int) -> float:
        """How far behind the beginning of a segment vehicles may have to wait first: at a crossing, or where ways come together."""
        shape = self.network["zones"][zone]
        crosses = [float(area["from_m"]) for crossing in shape["crossings"] for area in crossing["places"] if area["segment"] == inner]
        return min([*crosses, float(shape["segments"][inner]["length_m"])])

    def legs_of(self, zone: int) -> list[Leg]:
        """The roads between where ways part and SUMO's junction, which begins at the first conflict points as on real roads: whoever waits in
        front of them for drivers of SUMO's is not in the junction to these, and does not have them wait for it."""
        shape, lines = self.network["zones"][zone], self.shapes[zone]
        if not shape["crossings"]:
            return []
        inner = {path["segments"][1]: path["segments"][0] for path in shape["paths"] if len(path["segments"]) > 1}
        starts = sorted(set(inner.values()))
        legs = []
        while starts:
            first = starts[0]
            beside = [
                at for at in starts if math.dist(lines[first][-1], lines[at][-1]) < BESIDE_M and straightness(lines[first][-2:], lines[at][-2:]) > 0.7
            ]
            starts = [at for at in starts if at not in beside]
            (ax, ay), (bx, by) = lines[first][-2:]

            def leftward(place: Place) -> float:
                return float((bx - ax) * (place[1] - by) - (by - ay) * (place[0] - bx))

            # By where they are, and those that part from one by where they lead.
            lanes = [(at, way) for way, at in inner.items() if at in beside]
            lanes.sort(key=lambda lane: (leftward(lines[lane[0]][-1]), leftward(lines[lane[1]][-1])))
            length_m = min(self.first_m(zone, way) for _, way in lanes) + INTO_M
            if length_m > LEAST_M:
                legs.append(Leg(f"z{zone}s{first}b", length_m, lanes))
        return legs

    def edges(self, way: Iterable[tuple[int, int]]) -> list[str]:
        """The edges of a way."""
        way, names = list(way), []
        for zone, path in way:
            at = self.entrance(zone, path)
            names += [f"z{zone}s{at}", *([self.legs[zone][at].edge] if at in self.legs[zone] else [])]
        last, path = way[-1]
        exit_ = self.network["zones"][last]["paths"][path]["exit"]
        return [*names, f"z{last}x{exit_}"]

    def has_way(self, zone: int) -> set[int]:
        """The entrances whose vehicles have the right of way where SUMO decides: the first that is named, and where ways cross all
        that come along its line, from both sides."""
        shape, lines = self.network["zones"][zone], self.shapes[zone]
        starts = [index for index, segment in enumerate(shape["segments"]) if segment["source"] is not None]
        if not shape["crossings"]:
            return set(starts[:1])
        return {at for at in starts if abs(straightness(lines[starts[0]][-2:], lines[at][-2:])) > 0.7}

    def write(self, folder: str, junctions: str) -> str:
        """Has netconvert make the network; returns its path."""
        nodes, edges, connections = ["<nodes>"], ["<edges>"], ["<connections>"]
        roads: dict[str, Sequence[Place]] = {}
        ways: dict[Way, Sequence[Place]] = {}
        onto_m = [ONTO_M if zone["crossings"] else 0.0 for zone in self.network["zones"]]
        speed = f'speed="{self.v_max_mps}"'

        def connect(way: Way, length_m: float, line: Sequence[Place]) -> None:
            ways[way] = line
            # Whoever turns left waits before the junction and not in the midst of it (`contPos`), where others would have to get past.
            connections.append(
                f'<connection from="{way.start}" to="{way.end}" fromLane="{way.start_lane}" toLane="{way.end_lane}" '
                f'length="{length_m:.6f}" {speed} contPos="0"/>'
            )

        for zone, shape in enumerate(self.network["zones"]):
            segments, lines = shape["segments"], self.shapes[zone]
            side_by_side = apart(shape, lines)
            middle = lines[shape["paths"][0]["segments"][-1]][-1]
            if len(shape["paths"]) > len(shape["exits"]) and shape["crossings"]:
                ends = [lines[path["segments"][-1]][-1] for path in shape["paths"]]
                middle = [sum(end[axis] for end in ends) / len(ends) for axis in (0, 1)]
            nodes.append(f'<node id="z{zone}" x="{middle[0]:.2f}" y="{middle[1]:.2f}" type="{junctions}"/>')
            starts = [index for index, segment in enumerate(segments) if segment["source"] is not None]
            has_way = self.has_way(zone)
            for at in starts:
                source, line = segments[at]["source"], side_by_side[at]
                own_m = float(segments[at]["length_m"]) - self.inside_m(zone, at)
                begin = f"z{zone}s{at}o"
                link_m = 0.0
                if "Zone" in source:
                    begin = f"z{source['Zone']['zone']}"
                    upstream = self.network["zones"][source["Zone"]["zone"]]
                    link_m = float(upstream["exits"][source["Zone"]["exit"]]["to"]["link_m"]) - onto_m[source["Zone"]["zone"]]
                else:
                    nodes.append(f'<node id="{begin}" x="{line[0][0]:.2f}" y="{line[0][1]:.2f}"/>')
                # Those who have the right of way, where SUMO decides.
                of = f'{speed} priority="{2 if at in has_way else 1}" spreadType="center"'
                whole_m = float(segments[at]["length_m"])
                drawn = between(line, 0.0, 1.0 - self.inside_m(zone, at) / whole_m)
                leg, end = self.legs[zone].get(at), f"z{zone}"
                if leg is not None:
                    end = f"{leg.edge}o"
                    for lane, inner in ((leg.lane(inner), inner) for on, inner in leg.lanes if on == at):
                        length_m = float(segments[inner]["length_m"])
                        share = [min(1.0, to_m / length_m) for to_m in (PARTS_M, leg.length_m)]
                        connect(Way(f"z{zone}s{at}", leg.edge, 0, lane), PARTS_M, between(side_by_side[inner], 0.0, share[0]))
                        roads[f"{leg.edge}_{lane}"] = between(side_by_side[inner], *share)
                    if at == leg.lanes[0][0]:
                        x, y = drawn[-1]
                        nodes.append(f'<node id="{end}" x="{x:.2f}" y="{y:.2f}" type="priority"/>')
                        # Who is on the wrong lane would not get off the other's way.
                        lanes = "".join(f'<lane index="{lane}" changeLeft="custom1" changeRight="custom1"/>' for lane in range(len(leg.lanes)))
                        edges.append(
                            f'<edge id="{leg.edge}" from="{end}" to="z{zone}" numLanes="{len(leg.lanes)}" length="{leg.length_m - PARTS_M:.6f}" {of}>'
                            f"{lanes}</edge>"
                        )
                roads[f"z{zone}s{at}_0"] = drawn
                edges.append(f'<edge id="z{zone}s{at}" from="{begin}" to="{end}" numLanes="1" length="{own_m + link_m:.6f}" {of}/>')
            beyond: dict[int, Place] = {}
            for index, exit_ in enumerate(shape["exits"]):
                # As the straightest of the ways there goes on: netconvert sees by directions who crosses whom.
                leading = [path["segments"] for path in shape["paths"] if path["exit"] == index]
                line = lines[max(leading, key=lambda way: straightness(lines[way[0]], lines[way[-1]]))[-1]]
                (ax, ay), (bx, by) = line[-2], line[-1]
                long_m = math.dist((ax, ay), (bx, by)) or 1.0
                beyond[index] = (bx + (bx - ax) / long_m * onto_m[zone], by + (by - ay) / long_m * onto_m[zone])
                if exit_["to"] is None:
                    x, y = bx + (bx - ax) / long_m * BEYOND_M, by + (by - ay) / long_m * BEYOND_M
                    roads[f"z{zone}x{index}_0"] = [beyond[index], (x, y)]
                    nodes.append(f'<node id="z{zone}x{index}o" x="{x:.2f}" y="{y:.2f}"/>')
                    edges.append(
                        f'<edge id="z{zone}x{index}" from="z{zone}" to="z{zone}x{index}o" numLanes="1" '
                        f'{speed} length="{BEYOND_M - onto_m[zone]}" priority="2" spreadType="center"/>'
                    )
            for path in shape["paths"]:
                first, inner = path["segments"][0], path["segments"][1:]
                inside_m = self.inside_m(zone, first)
                own_m = float(segments[first]["length_m"])
                line = side_by_side[first]
                drawn = cut(line, 1.0 - inside_m / own_m) if inside_m else []
                for segment in inner:
                    drawn += [place for place in side_by_side[segment] if not drawn or place != drawn[-1]]
                inside_m += sum(float(segments[segment]["length_m"]) for segment in inner)
                leg = self.legs[zone].get(first)
                if leg is not None:
                    drawn = cut(drawn, min(0.999, leg.length_m / inside_m))
                    inside_m -= leg.length_m
                if onto_m[zone] > 0.0:
                    drawn.append(beyond[path["exit"]])
                exit_ = shape["exits"][path["exit"]]["to"]
                to = f"z{zone}x{path['exit']}" if exit_ is None else f"z{exit_['zone']}s{exit_['segment']}"
                way = Way(f"z{zone}s{first}", to) if leg is None else Way(leg.edge, to, leg.lane(inner[0]))
                connect(way, inside_m + onto_m[zone], drawn)
        base = os.path.join(folder, "replica")
        for name, lines_ in (("nod", [*nodes, "</nodes>"]), ("edg", [*edges, "</edges>"]), ("con", [*connections, "</connections>"])):
            with open(f"{base}.{name}.xml", "w") as file:
                file.write("\n".join(lines_) + "\n")
        options = ["--no-turnarounds", "true", "--no-warnings", "true", "--precision", "6"]
        options += ["--tls.default-type", "actuated", "--offset.disable-normalization", "true"]
        given = ["-n", f"{base}.nod.xml", "-e", f"{base}.edg.xml", "-x", f"{base}.con.xml"]
        make("netconvert", *given, "-o", f"{base}.net.xml", *options)
        draw(f"{base}.net.xml", roads, ways)
        return f"{base}.net.xml"


class ReplicaTraffic(Traffic):
    """SUMO moves the vehicles that a scenario's own gates let in."""

    name = "sumo"
    brings = False

    def __init__(self, replica: Replica, scenario: dict[str, typing.Any], simulation: Simulation, share: float) -> None:
        self.replica, self.simulation, self.share = replica, simulation, share
        self.seed = int(scenario["seed"])
        self.fleet = scenario["fleet"]
        self.routes: dict[tuple[str, ...], str] = {}
        self.cars: dict[int, Car] = {}
        #: Those that have left a zone and not yet SUMO's junction, and where they are on their routes.
        self.passing: list[tuple[Car, int]] = []
        for index, kind in enumerate(self.fleet):
            self.add_types(index, kind["vehicle"])

    def add_types(self, index: int, vehicle: dict[str, float]) -> None:
        """SUMO's types of a kind: one that is automated, and one that SUMO's default driver drives."""
        types = libsumo.vehicletype
        for name in (f"cav{index}", f"human{index}"):
            types.copy("DEFAULT_VEHTYPE", name)
            types.setLength(name, vehicle["length_m"])
            types.setMaxSpeed(name, vehicle["v_max_mps"])
        types.setAccel(f"cav{index}", vehicle["u_max_mps2"])
        types.setDecel(f"cav{index}", -vehicle["u_min_mps2"])
        types.setEmergencyDecel(f"cav{index}", -vehicle["u_min_mps2"])
        types.setMinGap(f"cav{index}", 0.0)
        types.setImperfection(f"cav{index}", 0.0)

    def step(self, step: int, tasks: Sequence[tuple[float, int, int]]) -> tuple[Iterable[float], Sequence[Newcomer], bool]:
        """One step of SUMO."""
        simulation, cars = self.simulation, self.cars
        for u_mps2, vehicle, is_held in tasks:
            if is_held:
                simulation.hold(cars[vehicle], u_mps2)
            elif vehicle in cars and cars[vehicle].is_driven:
                self.leave(cars[vehicle])
        simulation.step()
        self.passing = [one for one in self.passing if not self.is_through(*one)]
        did: list[float] = []
        for _, vehicle, _ in tasks:
            car = cars.get(vehicle)
            if car is not None and simulation.moves(car):
                did += (car.advanced_m, car.v_mps)
            else:
                cars.pop(vehicle, None)
                did.extend(GONE)
        return did, (), False

    def leave(self, car: Car) -> None:
        """Leaves one to SUMO's own driver. Where the zone ends before SUMO's junction does, even before that begins, the order has given it the
        right of way, and whoever comes behind waits for it to go: so it does not ask SUMO for it."""
        edge = "" if car.name in self.simulation.gone else str(libsumo.vehicle.getRoadID(car.name))
        if edge in self.replica.approaches or edge.startswith(":") and self.replica.approaches:
            self.simulation.release(car, THROUGH)
            self.passing.append((car, libsumo.vehicle.getRouteIndex(car.name)))
        else:
            self.simulation.release(car)

    def is_through(self, car: Car, index: int) -> bool:
        """Whether one is on the road behind the junction, or no more there; it asks for the right of way again then."""
        if car.name in self.simulation.gone:
            return True
        if libsumo.vehicle.getRoadID(car.name).startswith(":") or libsumo.vehicle.getRouteIndex(car.name) == index:
            return False
        if not car.is_driven:
            libsumo.vehicle.setSpeedMode(car.name, SUMOS)
        return True

    def admit(self, vehicles: Sequence[Admitted]) -> Sequence[bool]:
        """Puts them on their first edge."""
        commanded = []
        for x_m, v_mps, vehicle, kind, _, way in vehicles:
            is_commanded = self.share >= 1.0 or is_automated(self.seed, vehicle, self.share)
            edges = tuple(self.replica.edges(way))
            if edges not in self.routes:
                self.routes[edges] = f"r{len(self.routes)}"
                libsumo.route.add(self.routes[edges], edges)
            name, vehicles_ = str(vehicle), libsumo.vehicle
            of = f"{'cav' if is_commanded else 'human'}{kind}"
            vehicles_.add(name, self.routes[edges], of, departPos=repr(x_m), departSpeed=repr(v_mps))
            # Here and now, not when SUMO would find it fit.
            vehicles_.moveTo(name, f"{edges[0]}_0", x_m)
            vehicles_.setPreviousSpeed(name, v_mps)
            if is_commanded:
                vehicles_.setSpeedFactor(name, 1.0)
            self.cars[vehicle] = car = Car(name)
            self.simulation.see(car)
            self.simulation.began_s[name] = libsumo.simulation.getTime()
            self.simulation.totals.departed += 1
            commanded.append(is_commanded)
        return commanded
