package org.psao;

import java.nio.ByteBuffer;
import java.nio.ByteOrder;

/** Memory that native code writes to and Java reads, whose address is looked up once. */
final class Words {
    final ByteBuffer bytes;
    final long address;

    /** @param count of 64 bits */
    Words(int count) {
        bytes = ByteBuffer.allocateDirect(8 * count).order(ByteOrder.nativeOrder());
        address = Native.address(bytes);
    }

    long get(int index) {
        return bytes.getLong(8 * index);
    }

    float real(int index) {
        return Float.intBitsToFloat((int) get(index));
    }
}
