// List the splats of each tile. Splats are sorted by depth, so their pairs with tiles are too. A stable sort by tile
// then lists the splats of every tile front to back. Tiles are in row-major order, and one band of tiles is binned at a
// time.

struct Parameters {
    count: u32,  // of splats
    across: u32,
    first: u32,
    end: u32,
    capacity: u32,  // maximum number of pairs; further pairs are left out
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> rows: array<Row>;
@group(0) @binding(2) var<storage, read> order: array<u32>;  // splats by depth
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;  // of the band's tiles per splat, by depth
@group(0) @binding(4) var<storage, read> starts: array<u32>;  // first pair of each splat, and the end
@group(0) @binding(5) var<storage, read_write> spans: array<vec2u>;  // of each splat: first pair and number of pairs
@group(0) @binding(6) var<storage, read_write> owners: array<u32>;  // splat of each pair
@group(0) @binding(7) var<storage, read_write> tiles: array<u32>;  // tile of each pair
@group(0) @binding(8) var<storage, read_write> pairs: array<u32>;  // index of each pair
@group(0) @binding(9) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(10) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(11) var<storage, read> owner_of: array<u32>;
@group(0) @binding(12) var<storage, read_write> entries: array<vec2u>;  // splat and index of each sorted pair
@group(0) @binding(13) var<storage, read_write> ranges: array<vec2u>;  // of each tile: first pair and end

const SPAN = f32(TILE - 1);  // distance from a tile's first pixel centre to its last

// Return the first tile and one past the last with pixel centres within reach of a point.
fn tile_range(middle: f32, reach: f32, tiles: u32) -> vec2u {
    let low = floor((middle - reach - 0.5) / f32(TILE));
    let high = floor((middle + reach - 0.5) / f32(TILE)) + 1.0;
    let range = vec2u(clamp(vec2f(low, high), vec2f(0.0), vec2f(f32(tiles))));
    return min(range, vec2u(tiles));  // NaN may convert to any integer
}

// Return the band's rows of tiles within reach.
fn lines_of(row: Row) -> vec2u {
    let down = (u.end + u.across - 1u) / u.across;
    return max(tile_range(row.mean.y, row.half_size.y, down), vec2u(u.first / u.across));
}

fn touches_tile(row: Row, x: u32, y: u32) -> bool {
    let tile = y * u.across + x;
    return tile >= u.first && tile < u.end
        && touches(row, vec2f(f32(x * TILE), f32(y * TILE)) + 0.5, vec2f(SPAN));
}

@compute @workgroup_size(LANES)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let row = rows[order[k]];
    var touched = 0u;
    if (row.radius > 0.0) {
        let columns = tile_range(row.mean.x, row.half_size.x, u.across);
        let lines = lines_of(row);
        for (var y = lines.x; y < lines.y; y++) {
            for (var x = columns.x; x < columns.y; x++) { touched += u32(touches_tile(row, x, y)); }
        }
    }
    counts[k] = touched;
}

// A driver may compile the same test differently here and in `count`. So no more pairs are made than were counted, and
// missing pairs are assigned to a tile outside the band.
@compute @workgroup_size(LANES)
fn make_pairs(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let k = group_of(group) * LANES + lane;
    if (k >= u.count) { return; }
    let splat = order[k];
    let end = min(starts[k + 1u], u.capacity);
    var at = min(starts[k], u.capacity);
    let first = at;
    let row = rows[splat];
    if (row.radius > 0.0) {
        let columns = tile_range(row.mean.x, row.half_size.x, u.across);
        let lines = lines_of(row);
        for (var y = lines.x; y < lines.y; y++) {
            for (var x = columns.x; x < columns.y; x++) {
                if (at < end && touches_tile(row, x, y)) {
                    owners[at] = splat;
                    tiles[at] = y * u.across + x;
                    pairs[at] = at;
                    at++;
                }
            }
        }
    }
    spans[splat] = vec2u(first, at - first);
    for (; at < end; at++) {
        owners[at] = splat;
        tiles[at] = u.end;
        pairs[at] = at;
    }
}

// Find the range of each tile's pairs, and their splats.
@compute @workgroup_size(LANES)
fn find_ranges(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = group_of(group) * LANES + lane;
    let total = min(starts[u.count], u.capacity);
    if (at >= total) { return; }
    entries[at] = vec2u(owner_of[sorted_pairs[at]], sorted_pairs[at]);
    let tile = sorted_tiles[at];
    if (tile == u.end) { return; }
    if (at == 0u || sorted_tiles[at - 1u] != tile) { ranges[tile].x = at; }
    if (at + 1u == total || sorted_tiles[at + 1u] != tile) { ranges[tile].y = at + 1u; }
}
