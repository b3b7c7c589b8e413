// Exclusive prefix sums of unsigned integers, in place. One workgroup sums up a few thousand; of more, the sum of each
// block of 1024 is taken first, and what lies before each is added in the end.

struct Parameters { count: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;  // of each block
@group(0) @binding(3) var<storage, read> starts: array<u32>;  // what lies before each block

const EACH: u32 = 16;  // values that an invocation takes, one after the other
const BLOCK: u32 = LANES * EACH;
var<workgroup> shares: array<u32, LANES>;

// Each invocation's share of a block's sum; all invocations come here together.
fn share_out(block: u32, lane: u32) {
    var sum = 0u;
    let first = block * BLOCK + lane * EACH;
    for (var k = first; k < min(first + EACH, u.count); k++) { sum += values[k]; }
    workgroupBarrier();
    shares[lane] = sum;
    workgroupBarrier();
}

// The sum of the shares of the invocations before this one.
fn before(lane: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < lane; k++) { sum += shares[k]; }
    return sum;
}

fn write_sums(block: u32, lane: u32, start: u32) {
    var at = start + before(lane);
    let first = block * BLOCK + lane * EACH;
    for (var k = first; k < min(first + EACH, u.count); k++) {
        let value = values[k];
        values[k] = at;
        at += value;
    }
}

@compute @workgroup_size(LANES)
fn total(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    share_out(block, lane);
    if (lane == 0u) { totals[block] = before(LANES); }
}

@compute @workgroup_size(LANES)
fn spread(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    share_out(block, lane);
    write_sums(block, lane, starts[block]);
}

@compute @workgroup_size(LANES)
fn few(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    var done = 0u;
    for (var block = group_of(group); block * BLOCK < u.count; block++) {
        share_out(block, lane);
        write_sums(block, lane, done);
        done += before(LANES);
    }
}
