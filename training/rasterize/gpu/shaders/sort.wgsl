// One pass of a stable radix sort of keys with values, by eight bits. `scan_blocks` sums the counts of each digit over
// the blocks of pairs, and `scatter` copies every pair to its position. It also counts the digits of the next pass; those
// of the first pass are counted by `count`.

struct Parameters {
    count: u32,  // maximum number of pairs
    shift: u32,
    blocks: u32,
    slot: u32,  // of the number of pairs in totals
    bits: u32,  // of all passes
}
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> places: array<u32>;  // (DIGITS, blocks + 1): of each block, and the sum
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;
@group(0) @binding(6) var<storage, read> totals: array<u32>;
@group(0) @binding(7) var<storage, read_write> next_places: array<atomic<u32>>;  // counts of the next pass

const DIGITS: u32 = 256;
const WIDE: u32 = 256;  // invocations, one per digit
const ROWS: u32 = 8;  // pairs per invocation
const BITS: u32 = 8;
const WORDS: u32 = WIDE / 32;
var<workgroup> tally: array<atomic<u32>, DIGITS>;
var<workgroup> sums: array<u32, DIGITS>;
var<workgroup> lanes_of: array<atomic<u32>, DIGITS * WORDS>;  // bit mask of the invocations with each digit

fn digit_of(key: u32, shift: u32) -> u32 {
    return (key >> shift) % DIGITS;
}

fn pair_count() -> u32 {
    return min(u.count, totals[u.slot]);
}

// Return the sum of the values of all invocations before this one; call in uniform control flow.
fn sum_before(value: u32, lane: u32) -> u32 {
    sums[lane] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < WIDE; reach *= 2u) {
        var sum = sums[lane];
        if (lane >= reach) { sum += sums[lane - reach]; }
        workgroupBarrier();
        sums[lane] = sum;
        workgroupBarrier();
    }
    return sums[lane] - value;
}

@compute @workgroup_size(WIDE)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    let end = pair_count();
    atomicStore(&tally[lane], 0u);
    workgroupBarrier();
    for (var row = 0u; row < ROWS; row++) {
        let k = (block * ROWS + row) * WIDE + lane;
        if (k < end) { atomicAdd(&tally[digit_of(keys[k], u.shift)], 1u); }
    }
    workgroupBarrier();
    places[lane * (u.blocks + 1u) + block] = atomicLoad(&tally[lane]);
}

// Replace the counts of one digit by their sums before each block, and clear those of the next pass.
@compute @workgroup_size(WIDE)
fn scan_blocks(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let row = group_of(group) * (u.blocks + 1u);
    let length = (u.blocks + WIDE - 1u) / WIDE;
    let first = min(lane * length, u.blocks);
    let end = min(first + length, u.blocks);
    var sum = 0u;
    for (var block = first; block < end; block++) { sum += places[row + block]; }
    var at = sum_before(sum, lane);
    for (var block = first; block < end; block++) {
        let count = places[row + block];
        places[row + block] = at;
        at += count;
        atomicStore(&next_places[row + block], 0u);
    }
    if (lane == WIDE - 1u) { places[row + u.blocks] = at; }
}

@compute @workgroup_size(WIDE)
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    let end = pair_count();
    let row_of_digit = lane * (u.blocks + 1u);
    let smaller_digits = sum_before(places[row_of_digit + u.blocks], lane);
    atomicStore(&tally[lane], smaller_digits + places[row_of_digit + block]);  // next position of each digit
    for (var word = 0u; word < WORDS; word++) { atomicStore(&lanes_of[word * WIDE + lane], 0u); }
    workgroupBarrier();
    for (var row = 0u; row < ROWS; row++) {
        let k = (block * ROWS + row) * WIDE + lane;
        let valid = k < end;
        var key = 0u;
        if (valid) { key = keys[k]; }
        let digit = digit_of(key, u.shift);
        let bit = 1u << (lane % 32u);
        if (valid) { atomicOr(&lanes_of[digit * WORDS + lane / 32u], bit); }
        workgroupBarrier();
        var before = 0u;  // invocations before this one with the same digit
        var same = 0u;
        for (var word = 0u; word < WORDS; word++) {
            let mask = atomicLoad(&lanes_of[digit * WORDS + word]);
            same += countOneBits(mask);
            if (word < lane / 32u) { before += countOneBits(mask); }
            if (word == lane / 32u) { before += countOneBits(mask & (bit - 1u)); }
        }
        let at = atomicLoad(&tally[digit]) + before;
        if (valid) {
            sorted_keys[at] = key;
            sorted_values[at] = values[k];
            let next_shift = u.shift + BITS;
            if (next_shift < u.bits) {
                atomicAdd(&next_places[digit_of(key, next_shift) * (u.blocks + 1u) + at / (ROWS * WIDE)], 1u);
            }
        }
        workgroupBarrier();
        if (valid) {
            atomicStore(&lanes_of[digit * WORDS + lane / 32u], 0u);
            if (before + 1u == same) { atomicStore(&tally[digit], at + 1u); }
        }
        workgroupBarrier();
    }
}
