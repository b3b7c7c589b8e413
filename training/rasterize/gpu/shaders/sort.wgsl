// One pass of a stable radix sort of keys with values, by four bits. Blocks of 1024 pairs count their digits, the
// shader `scan` sums the counts by digit and block, and every pair is copied to its position.

struct Parameters {
    count: u32,  // maximum number of pairs
    shift: u32,
    blocks: u32,
    slot: u32,  // of the number of pairs in totals
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> places: array<u32>;  // (16, blocks)
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;
@group(0) @binding(6) var<storage, read> totals: array<u32>;

const DIGITS: u32 = 16;
const PER_LANE: u32 = 16;  // consecutive pairs per invocation, which makes the sort stable
var<workgroup> tally: array<u32, DIGITS * LANES>;  // (digits, lanes)

fn digit_of(key: u32) -> u32 {
    return (key >> u.shift) % DIGITS;
}

fn pair_count() -> u32 {
    return min(u.count, totals[u.slot]);
}

fn count_digits(first: u32, lane: u32) {
    for (var digit = 0u; digit < DIGITS; digit++) { tally[digit * LANES + lane] = 0u; }
    for (var k = first; k < min(first + PER_LANE, pair_count()); k++) {
        tally[digit_of(keys[k]) * LANES + lane] += 1u;
    }
}

@compute @workgroup_size(LANES)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    count_digits((block * LANES + lane) * PER_LANE, lane);
    workgroupBarrier();
    if (lane < DIGITS) {
        var sum = 0u;
        for (var k = 0u; k < LANES; k++) { sum += tally[lane * LANES + k]; }
        places[lane * u.blocks + block] = sum;
    }
}

@compute @workgroup_size(LANES)
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    let first = (block * LANES + lane) * PER_LANE;
    count_digits(first, lane);
    workgroupBarrier();
    if (lane < DIGITS) {  // from counts to positions
        var at = places[lane * u.blocks + block];
        for (var k = 0u; k < LANES; k++) {
            let count = tally[lane * LANES + k];
            tally[lane * LANES + k] = at;
            at += count;
        }
    }
    workgroupBarrier();
    for (var k = first; k < min(first + PER_LANE, pair_count()); k++) {
        let place = digit_of(keys[k]) * LANES + lane;
        let at = tally[place];
        tally[place] = at + 1u;
        sorted_keys[at] = keys[k];
        sorted_values[at] = values[k];
    }
}
